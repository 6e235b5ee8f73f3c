"""Attempts at the tasks of the multimodal Meta-World, and their files. Every collecting program uses this module."""

from __future__ import annotations

import functools
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
"""Shape of a row and dtype of each extra array of `TaskEpisode`, by name."""


@dataclass(frozen=True)
class TaskEpisode:
    """
    One attempt at a task, T decisions long.

    :param task: the attempted task
    :param seed: seed of the environment's reset
    :param observations: (T + 1, ...), as the environment returns them
    :param actions: (T, 4) float32
    :param task_success: (T, 5) bool, success of each task after each decision
    :param task_reward: (T, 5) float32, reward of each task
    :param state: (T, 21) float32, the state observation after each decision, whatever the environment observes
    :param scene_state: (T, 30) float64, `TableScene.get_state` after each decision: redraws the scene to the byte
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
        """(T,) bool, success of the attempted task."""
        return self.task_success[:, TASKS.index(self.task)]

    @property
    def solved(self) -> bool:
        """True if the attempted task was solved after some decision."""
        return bool(self.success.any())


@functools.lru_cache(maxsize=1)
def shared_env(obs_type: str) -> gym.Env:
    """
    Create the one environment that all episodes of a process share. It fits every task, because the tasks share their scene.

    :param obs_type: "state" or "pixels"
    :return: the environment
    """
    return gym.make(ENV_ID, obs_type=obs_type)


def roll_out(env: gym.Env, task: str, seed: int, act: Callable[[int, bool], np.ndarray]) -> TaskEpisode:
    """
    Play one episode.

    :param env: from `shared_env`; it may reward any task
    :param task: the attempted task
    :param seed: seed of the reset
    :param act: maps the number of earlier decisions, and whether the task is solved by now, to a (4,) float32 action. It reads
        what else it needs from the environment.
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
    Open a dataset file for attempts.

    `success` of a step is success of the attempted task, which is the episode's `source`. The file holds no `rewards`: they
    would mix the rewards of five tasks. The extras are those of `TaskEpisode`; with `state` among them, files of images
    hold the states too.

    :param path: path of the file
    :param obs_type: "state" or "pixels"
    :param tasks: the sources
    :param n_episodes: number of episodes that will be added
    :param provenance: how the data are made
    :param mode: see `DatasetWriter`
    :return: the writer, for `add_episode`
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
    :param writer: from `episode_writer`
    :param episode: an attempt at one of the writer's tasks
    """
    writer.add_episode(
        episode.observations,
        episode.actions,
        success=episode.success,
        extras={name: getattr(episode, name) for name in _EXTRAS},
        seed=episode.seed,
        source=episode.task,
    )


def check_tasks(tasks: Sequence[str]) -> None:
    """
    :param tasks: names of tasks; raises ``ValueError`` if one is not in `TASKS`
    """
    unknown = set(tasks) - set(TASKS)
    if unknown:
        raise ValueError(f"Unknown tasks {sorted(unknown)}; choose from {', '.join(TASKS)}.")
