"""Attempts at the tasks of the multimodal Meta-World and the files that hold them: what all collecting programs share."""

from __future__ import annotations

import functools
import importlib.metadata
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from sb3_offline.data.writer import DatasetWriter
from sb3_offline.envs import ENV_ID
from sb3_offline.envs.multimodal_metaworld import TASKS
from sb3_offline.envs.multimodal_metaworld.env import STATE_NAMES

_EXTRAS: dict[str, tuple[tuple[int, ...], str]] = {
    "task_success": ((5,), "bool"),
    "task_reward": ((5,), "float32"),
    "state": ((len(STATE_NAMES),), "float32"),
    "scene_state": ((30,), "float64"),
}
"""Of `TaskEpisode`: shape of a row and dtype, by name."""


@dataclass(frozen=True)
class TaskEpisode:
    """
    T decisions of one attempt at `task`.

    :param task: what was attempted
    :param seed: of the environment's reset
    :param observations: (T + 1, ...) of the environment
    :param actions: (T, 4) float32
    :param task_success: (T, 5) bool, after each decision
    :param task_reward: (T, 5) float32
    :param state: (T, 21) float32, the environment's state observation after each decision, whatever it observes
    :param scene_state: (T, 30) float64, `TableScene.get_state` after each decision, to draw it again to the byte
    """

    task: str
    seed: int
    observations: np.ndarray
    actions: np.ndarray
    task_success: np.ndarray
    task_reward: np.ndarray
    state: np.ndarray
    scene_state: np.ndarray

    @property
    def success(self) -> np.ndarray:
        """:return: (T,) bool, of the attempted task"""
        return self.task_success[:, TASKS.index(self.task)]

    @property
    def solved(self) -> bool:
        """:return: whether the attempted task was solved after some decision"""
        return bool(self.success.any())


@functools.lru_cache(maxsize=1)
def shared_env(obs_type: str) -> gym.Env:
    """
    :param obs_type: "state" or "pixels"
    :return: one environment for all episodes of a process: the tasks share their scene
    """
    return gym.make(ENV_ID, obs_type=obs_type)


def roll_out(env: gym.Env, task: str, seed: int, act: Callable[[int, bool], np.ndarray]) -> TaskEpisode:
    """
    :param env: of `shared_env`, whichever task it rewards
    :param task: what is attempted
    :param seed: of the reset
    :param act: from the number of decisions before, and whether the task has been solved by now, to a (4,) float32 action; it
        looks at the environment itself
    :return: the episode
    """
    scene_env: Any = env.unwrapped
    index = TASKS.index(task)
    observation, _ = env.reset(seed=seed)
    observations = [observation]
    actions: list[np.ndarray] = []
    successes, rewards, states, scene_states = [], [], [], []
    solved = truncated = False
    while not truncated:
        action = act(len(actions), solved)
        observation, _, _, truncated, info = env.step(action)
        solved = solved or bool(info["task_success"][index])
        observations.append(observation)
        actions.append(action)
        successes.append(info["task_success"])
        rewards.append(info["task_reward"])
        states.append(scene_env.get_state())
        scene_states.append(scene_env.scene.get_state())
    steps = (observations, actions, successes, rewards, states, scene_states)
    return TaskEpisode(task, seed, *map(np.stack, steps))


def episode_writer(
    path: str | os.PathLike[str],
    obs_type: str,
    tasks: Sequence[str],
    n_episodes: int,
    provenance: Mapping[str, Any],
    mode: Literal["x", "w", "a"],
) -> DatasetWriter:
    """
    A step's `success` is that of the attempted task, which is the episode's `source`; the file holds no `rewards`, since those
    of five tasks would be mixed in it. Extras: those of `TaskEpisode`; with `state` among them, files of frames hold it too.

    :param path: of the file
    :param obs_type: "state" or "pixels"
    :param tasks: the sources
    :param n_episodes: how many will be added
    :param provenance: of the data
    :param mode: of `DatasetWriter`
    :return: for `add_episode`
    """
    env = shared_env(obs_type)
    return DatasetWriter(
        path,
        env.observation_space,
        env.action_space,
        env_id=ENV_ID,
        env_kwargs={"obs_type": obs_type},
        provenance=provenance,
        mode=mode,
        rewards=False,
        extras=_EXTRAS,
        sources=list(tasks),
        capacity=(n_episodes, n_episodes * env.unwrapped.episode_length),  # type: ignore[attr-defined]
    )


def add_episode(writer: DatasetWriter, episode: TaskEpisode) -> None:
    """
    :param writer: of `episode_writer`
    :param episode: of one of its tasks
    """
    writer.add_episode(
        episode.observations,
        episode.actions,
        success=episode.success,
        extras={name: getattr(episode, name) for name in _EXTRAS},
        seed=episode.seed,
        source=episode.task,
    )


def versions() -> dict[str, str]:
    """:return: of the packages that decide what happens in an episode"""
    return {name: importlib.metadata.version(name) for name in ("metaworld", "mujoco", "gymnasium", "numpy")}


def check_tasks(tasks: Sequence[str]) -> None:
    """:param tasks: raises ``ValueError`` unless all of them are of `TASKS`"""
    unknown = set(tasks) - set(TASKS)
    if unknown:
        raise ValueError(f"Unknown tasks {sorted(unknown)}; choose from {', '.join(TASKS)}.")
