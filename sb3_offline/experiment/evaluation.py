"""Measure how often a policy succeeds."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize

from sb3_offline.common.offline_algorithm import OfflineAlgorithm

#: Seed of the first episode, far from the seeds of collected data.
EVALUATION_SEED = 100_000


@dataclass(frozen=True)
class Evaluation:
    """
    Outcome of an evaluation.

    :param successes: for each episode, True if it solved the task at any step
    :param returns: for each episode, its sum of rewards
    """

    successes: list[bool]
    returns: list[float]

    @property
    def success_rate(self) -> float:
        """Share of solved episodes."""
        return float(np.mean(self.successes))

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the success rate."""
        return success_interval(sum(self.successes), len(self.successes))


def success_interval(successes: int, episodes: int) -> tuple[float, float]:
    """
    Compute Wilson's 95 % interval. Unlike the normal approximation, it is informative at rates of 0 and 1.

    :param successes: number of episodes that succeeded
    :param episodes: number of all episodes
    :return: lower and upper end
    """
    z = 1.959964
    rate, spread = successes / episodes, z * z / episodes
    middle = (rate + spread / 2) / (1 + spread)
    half = z * math.sqrt(rate * (1 - rate) / episodes + spread / (4 * episodes)) / (1 + spread)
    return max(middle - half, 0.0), min(middle + half, 1.0)


def make_evaluation_env(env_id: str, env_kwargs: dict[str, Any], seed: int, n_stack: int = 1) -> VecEnv:
    """
    :param env_id: registered id of the environment
    :param env_kwargs: keyword arguments of the environment
    :param seed: seed of its episodes; the same seed gives the same initial states
    :param n_stack: number of frames that the policy sees at once
    :return: a vectorized environment of one, with SB3's ``Monitor``, and in a ``VecFrameStack`` for more than one frame
    """
    env = make_vec_env(env_id, seed=seed, env_kwargs=env_kwargs)
    return VecFrameStack(env, n_stack) if n_stack > 1 else env


def frames_seen_by(model: Any) -> int:
    """:return: the number of frames that a model or a policy sees at once"""
    return getattr(model, "n_stack", 1)


class PlainObservationPredictor:
    """
    A model that plays in plain environments: its observations are normalised as the model learned to see them.

    :param model: a model, of this library or of SB3, or a policy, which is taken to see plain observations
    """

    def __init__(self, model: PolicyPredictor):
        self.model = model
        self._normalizer: VecNormalize | None = None
        if isinstance(model, OfflineAlgorithm):
            self._normalizer = model.observation_normalizer()
        elif isinstance(model, BaseAlgorithm):
            self._normalizer = model.get_vec_normalize_env()

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """See SB3's ``predict``; the observation is a plain one."""
        if self._normalizer is not None:
            observation = self._normalizer.normalize_obs(observation)
        return self.model.predict(observation, state, episode_start, deterministic)


def evaluate_success(
    model: PolicyPredictor, env_id: str, env_kwargs: dict[str, Any], n_episodes: int = 50, seed: int = EVALUATION_SEED
) -> Evaluation:
    """
    Play the mode of a policy. Each call creates the environment, so that the same seed gives the same episodes.

    :param model: a model or a policy. The observations of a model that learned with a ``VecNormalize`` are normalised by the
        statistics that it learned with
    :param env_id: registered id of the environment, whose ``info`` must hold ``is_success``
    :param env_kwargs: keyword arguments of the environment
    :param n_episodes: number of episodes, at least one
    :param seed: seed of the episodes
    :return: successes and returns
    """
    if n_episodes < 1:
        raise ValueError(f"n_episodes is {n_episodes}; play at least one")
    player = PlainObservationPredictor(model)
    env = make_evaluation_env(env_id, env_kwargs, seed, frames_seen_by(model))
    successes: list[bool] = []
    solved = False

    def at_step(local: dict[str, Any], _: dict[str, Any]) -> None:
        nonlocal solved
        solved |= bool(local["info"].get("is_success"))  # at any step: not every environment still reports it at the last one
        if local["done"]:
            if "is_success" not in local["info"]:
                raise RuntimeError(f"The info of {env_id} holds no `is_success`, so success cannot be counted")
            successes.append(solved)
            solved = False

    try:
        returns, _ = evaluate_policy(
            player, env, n_episodes, deterministic=True, callback=at_step, return_episode_rewards=True
        )
    finally:
        env.close()
    return Evaluation(successes, list(returns))  # type: ignore[arg-type]
