"""An environment that consists of its spaces only, for models without an environment."""

from typing import Any, NoReturn

import gymnasium as gym
from gymnasium import spaces


class SpacesOnlyEnv(gym.Env):
    """
    A stand-in for the environment of a model that has only a dataset, so that SB3 finds the spaces it needs.

    :param observation_space: Observation space
    :param action_space: Action space
    """

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Space):
        self.observation_space = observation_space
        self.action_space = action_space

    def reset(self, **kwargs: Any) -> NoReturn:  # type: ignore[override]
        """:raises RuntimeError: always"""
        self._refuse()

    def step(self, action: Any) -> NoReturn:  # type: ignore[override]
        """:raises RuntimeError: always"""
        self._refuse()

    @staticmethod
    def _refuse() -> NoReturn:
        raise RuntimeError(
            "This model was created from a dataset alone, so it has no environment to reset or step. "
            "Give one with `model.set_env(env)`, or pass one to `evaluate_policy(model, env)`."
        )
