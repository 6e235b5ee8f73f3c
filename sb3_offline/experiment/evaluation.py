"""How often a policy succeeds."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv

#: Far from the seeds that data are collected with.
EVALUATION_SEED = 100_000


@dataclass(frozen=True)
class Evaluation:
    """
    :param successes: whether each episode solved the task at any of its steps
    :param returns: sum of rewards of each episode
    """

    successes: list[bool]
    returns: list[float]

    @property
    def success_rate(self) -> float:
        return float(np.mean(self.successes))

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the success rate (Wilson's)."""
        return success_interval(sum(self.successes), len(self.successes))


def success_interval(successes: int, episodes: int) -> tuple[float, float]:
    """
    Wilson's 95 % interval: unlike the normal approximation it says something at 0 and at 1.

    :param successes: episodes that succeeded
    :param episodes: all episodes
    :return: lower and upper end
    """
    z = 1.959964
    rate, spread = successes / episodes, z * z / episodes
    middle = (rate + spread / 2) / (1 + spread)
    half = z * math.sqrt(rate * (1 - rate) / episodes + spread / (4 * episodes)) / (1 + spread)
    return max(middle - half, 0.0), min(middle + half, 1.0)


def make_evaluation_env(env_id: str, env_kwargs: dict[str, Any], seed: int) -> VecEnv:
    """
    :param env_id: registered id
    :param env_kwargs: of the environment
    :param seed: of its episodes; the same seed gives the same starts
    :return: one environment with SB3's ``Monitor``
    """
    return make_vec_env(env_id, seed=seed, env_kwargs=env_kwargs)


def evaluate_success(
    model: PolicyPredictor, env_id: str, env_kwargs: dict[str, Any], n_episodes: int = 50, seed: int = EVALUATION_SEED
) -> Evaluation:
    """
    Play the policy's mode. The environment is new at each call, so that the same seed gives the same episodes.

    :param model: a model, or a policy of one
    :param env_id: registered id; its ``info`` must say ``is_success``
    :param env_kwargs: of the environment
    :param n_episodes: how many, at least one
    :param seed: of the episodes
    :return: what came out
    """
    if n_episodes < 1:
        raise ValueError(f"{n_episodes} episodes say nothing; play at least one")
    env = make_evaluation_env(env_id, env_kwargs, seed)
    successes: list[bool] = []
    solved = False

    def at_step(local: dict[str, Any], _: dict[str, Any]) -> None:
        nonlocal solved
        solved |= bool(local["info"].get("is_success"))  # at any step: not every environment keeps it up to the last
        if local["done"]:
            if "is_success" not in local["info"]:
                raise RuntimeError(f"{env_id} does not say `is_success` in its info, so success cannot be counted")
            successes.append(solved)
            solved = False

    try:
        returns, _ = evaluate_policy(model, env, n_episodes, deterministic=True, callback=at_step, return_episode_rewards=True)
    finally:
        env.close()
    return Evaluation(successes, list(returns))  # type: ignore[arg-type]
