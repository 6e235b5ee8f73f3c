"""Attempts at the tasks of the multimodal Meta-World, and files of them: what all collecting programs share."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from sb3_offline.data.spaces import stack_observations
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.envs import ENV_ID
from sb3_offline.envs.multimodal_metaworld.tables import find_table

_EXTRAS = {"task_success": "bool", "task_reward": "float32", "state": "float32", "scene_state": "float64"}
"""Arrays of `TaskEpisode` that a file holds as extras, with their dtypes."""


@dataclass(frozen=True)
class TaskEpisode:
    """
    One attempt at a task, T decisions long.

    :param task: the attempted task
    :param seed: seed of the environment's reset
    :param tasks: the table's tasks, in the order of `task_success`
    :param observations: (T + 1, ...) of the environment, or a dict of such arrays
    :param actions: (T, 4) float32
    :param task_success: (T, n_tasks) bool, after each decision
    :param task_reward: (T, n_tasks) float32
    :param state: (T, n) float32, the environment's state observation after each decision, also where it observes images
    :param scene_state: (T, m) float64, `TableScene.get_state` after each decision, enough to draw it again to the byte
    """

    task: str
    seed: int
    tasks: tuple[str, ...]
    observations: np.ndarray | dict[str, np.ndarray]
    actions: np.ndarray
    task_success: np.ndarray
    task_reward: np.ndarray
    state: np.ndarray
    scene_state: np.ndarray

    @property
    def success(self) -> np.ndarray:
        """:return: (T,) bool, success at the attempted task"""
        return self.task_success[:, self.tasks.index(self.task)]

    @property
    def solved(self) -> bool:
        """True if the attempted task was solved after some decision."""
        return bool(self.success.any())


@functools.lru_cache(maxsize=1)
def shared_env(obs_type: str, table: str = "paper") -> gym.Env:
    """
    Create the one environment that all episodes of a process share. It fits every task, because the tasks share their scene.

    :param obs_type: "state", "pixels" or "both"
    :param table: name of the table
    :return: one environment for all episodes of a process: the tasks share their scene
    """
    return gym.make(ENV_ID, **_env_kwargs(obs_type, table))


def _env_kwargs(obs_type: str, table: str) -> dict[str, Any]:
    # The default is left out, so that files of the paper's table stay as they are.
    return {"obs_type": obs_type} | ({} if table == "paper" else {"table": table})


def roll_out(env: gym.Env, task: str, seed: int, act: Callable[[int, bool], np.ndarray]) -> TaskEpisode:
    """
    :param env: environment of `shared_env`, whose rewarded task does not matter
    :param task: the task to attempt
    :param seed: seed of the reset
    :param act: from the number of decisions before, and whether the task has been solved by now, to a (4,) float32 action; it
        looks at the environment itself
    :return: the episode
    """
    scene_env: Any = env.unwrapped
    index = scene_env.tasks.index(task)
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
    steps = (actions, successes, rewards, states, scene_states)
    return TaskEpisode(task, seed, scene_env.tasks, stack_observations(observations), *map(np.stack, steps))


def episode_writer(
    path: str | os.PathLike[str],
    obs_type: str,
    tasks: Sequence[str],
    n_episodes: int,
    provenance: Mapping[str, Any],
    mode: Literal["x", "w", "a"],
    table: str = "paper",
) -> DatasetWriter:
    """
    A step's `success` is success at the attempted task, which is the episode's `source`. The file holds no `rewards`, since it
    would mix those of several tasks. Its extras are arrays of `TaskEpisode`; `state` is one of them, also beside images.

    :param path: path of the file
    :param obs_type: "state", "pixels" or "both"
    :param tasks: the sources
    :param n_episodes: number of episodes that will be added
    :param provenance: provenance of the data
    :param mode: as in `DatasetWriter`
    :param table: name of the table
    :return: a writer for `add_episode`
    """
    env = shared_env(obs_type, table)
    scene_env: Any = env.unwrapped
    n_tasks = len(scene_env.tasks)
    lengths = {"task_success": n_tasks, "task_reward": n_tasks, "state": len(scene_env.state_names)}
    lengths["scene_state"] = len(scene_env.scene.get_state())
    return DatasetWriter(
        path,
        env.observation_space,
        env.action_space,
        env_id=ENV_ID,
        env_kwargs=_env_kwargs(obs_type, table),
        provenance=provenance,
        mode=mode,
        rewards=False,
        extras={name: ((lengths[name],), dtype) for name, dtype in _EXTRAS.items()},
        sources=list(tasks),
        capacity=(n_episodes, n_episodes * scene_env.episode_length),
    )


def add_episode(writer: DatasetWriter, episode: TaskEpisode) -> None:
    """
    :param writer: writer of `episode_writer`
    :param episode: an attempt at one of its tasks
    """
    writer.add_episode(
        episode.observations,
        episode.actions,
        success=episode.success,
        extras={name: getattr(episode, name) for name in _EXTRAS},
        seed=episode.seed,
        source=episode.task,
    )


def check_tasks(tasks: Sequence[str], table: str = "paper") -> None:
    """
    :param tasks: raises ``ValueError`` unless the table has all of them
    :param table: name of the table
    """
    known = find_table(table).tasks
    if unknown := set(tasks) - set(known):
        raise ValueError(f"Unknown tasks {sorted(unknown)} of table {table!r}; choose from {', '.join(known)}.")
