"""
Demo data for the multimodal Meta-World: the stock scripted policies, with noise, wrong aims and aborted attempts.

These are not the learned agents of the CEBORL paper, but stand in for them: about a third of each task's episodes succeed.
"""

from __future__ import annotations

import contextlib
import functools
import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from metaworld import policies
from tqdm.auto import tqdm

from sb3_offline.common.provenance import SIMULATION_PACKAGES, installed_versions
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import WriteLock, replacing
from sb3_offline.data_tools.collecting.rollout import (
    TaskEpisode,
    add_episode,
    check_tasks,
    episode_writer,
    roll_out,
    shared_env,
)
from sb3_offline.envs.multimodal_metaworld import TASKS as TASKS
from sb3_offline.envs.multimodal_metaworld.tables import find_table
from sb3_offline.parallel.processes import map_in_order

BEHAVIOUR = "stock Meta-World scripted policies with noise, wrong aims and aborted attempts; no learned agents"


class Script(NamedTuple):
    policy: type[policies.policy.Policy]
    gain: float
    """Factor of the stock hand action."""
    n_decisions: int
    """Decisions within which the undisturbed script solves the task; attempts are aborted earlier."""
    noise: tuple[float, float]
    """Range of the action noise with which most straight attempts succeed."""
    straight: float
    """Share of attempts that go straight, chosen so that a third of all attempts succeed."""
    lets_go: bool = False
    """Whether the stock policy undoes its success, so that the hand has to stop there."""
    retreat: float | None = None
    """Height (m) to which a stopped hand withdraws, where it would go on pressing otherwise."""


SCRIPTS = {
    "dial-turn": Script(policies.SawyerDialTurnV3Policy, 1.0, 16, (0.03, 0.2), 0.37),
    "door-open": Script(policies.SawyerDoorOpenV3Policy, 1.0, 20, (0.03, 0.3), 0.28),
    "drawer-open": Script(policies.SawyerDrawerOpenV3Policy, 1.0, 20, (0.03, 0.3), 0.29),
    "lever-pull": Script(policies.SawyerLeverPullV3Policy, 0.5, 36, (0.03, 0.15), 0.34, lets_go=True),
    "plate-slide": Script(policies.SawyerPlateSlideV3Policy, 1.0, 23, (0.03, 0.3), 0.31),
    "button-press": Script(policies.SawyerButtonPressV3Policy, 1.0, 19, (0.03, 0.3), 0.28),
    "faucet-close": Script(policies.SawyerFaucetCloseV3Policy, 1.0, 26, (0.03, 0.3), 0.23),
    "faucet-open": Script(policies.SawyerFaucetOpenV3Policy, 1.0, 22, (0.03, 0.3), 0.2),
    "handle-press": Script(policies.SawyerHandlePressV3Policy, 1.0, 25, (0.03, 0.3), 0.28, lets_go=True, retreat=0.18),
    "window-open": Script(policies.SawyerWindowOpenV3Policy, 1.0, 24, (0.03, 0.3), 0.22),
}

# Shares of the ways in which the other attempts go.
_FAILINGS = {"aborted": 0.55, "misaimed": 0.3, "clumsy": 0.15}
_WORKSPACE_LOW, _WORKSPACE_HIGH = np.array([-0.45, 0.45, 0.08]), np.array([0.6, 0.85, 0.4])


class _Attempt:
    """One episode's behaviour: a stock policy and its disturbances, all drawn when the attempt begins."""

    def __init__(self, task: str, rng: np.random.Generator) -> None:
        self._script = SCRIPTS[task]
        self._policy = self._script.policy()
        self._rng = rng
        straight = rng.random() < self._script.straight
        manner = "straight" if straight else rng.choice(list(_FAILINGS), p=list(_FAILINGS.values()))
        self._speed = rng.uniform(0.8, 1.0)
        self._noise = rng.uniform(*{"straight": self._script.noise, "clumsy": (0.9, 1.5)}.get(manner, (0.1, 0.5)))
        self._aim = np.zeros(3)
        if manner == "misaimed":
            direction = rng.normal(size=3) * (1.0, 1.0, 0.5)
            self._aim = direction / np.linalg.norm(direction) * rng.uniform(0.09, 0.18)
        self._end = rng.integers(1, int(0.85 * self._script.n_decisions)) if manner == "aborted" else None
        self._rests_after_success = self._script.lets_go or rng.random() < 0.5
        self._afterwards = rng.choice(["rest", "drift", "leave"])
        self._drift = np.append(rng.uniform(-0.6, 0.6, 3), rng.uniform(-1.0, 1.0))
        self._elsewhere = rng.uniform(_WORKSPACE_LOW, _WORKSPACE_HIGH)

    def act(self, decision: int, stock_observation: np.ndarray, solved: bool) -> np.ndarray:
        """
        :param decision: number of decisions before this one
        :param stock_observation: (39,) stock observation of the attempted task
        :param solved: whether the task has been solved in this episode
        :return: (4,) float32 in [-1, 1]
        """
        hand = stock_observation[:3].copy()
        if self._end is not None and decision >= self._end and not solved:
            action = self._drift * (self._afterwards != "rest")
            if self._afterwards == "leave":
                action[:3] = np.clip(5.0 * (self._elsewhere - hand), -1.0, 1.0) * self._speed
        else:
            stock_observation[:3] += self._aim
            action = self._policy.get_action(stock_observation)
            action[:3] = np.clip(self._script.gain * action[:3], -1.0, 1.0) * self._speed
            if solved and self._rests_after_success:
                action[:3] = 0.0
                if self._script.retreat is not None:
                    action[2] = np.clip(10.0 * (self._script.retreat - hand[2]), -1.0, 1.0)
        noise = self._noise * self._rng.normal(size=4)
        return np.clip(action + noise, -1.0, 1.0).astype(np.float32)


def _episode_in_worker(obs_type: str, table: str, job: tuple[str, int]) -> TaskEpisode:
    task, seed = job
    env = shared_env(obs_type, table)
    scene_env: Any = env.unwrapped
    attempt = _Attempt(task, np.random.default_rng((seed, scene_env.tasks.index(task))))

    def act(decision: int, solved: bool) -> np.ndarray:
        return attempt.act(decision, scene_env.stock_observation(task), solved)

    with warnings.catch_warnings():
        # The stock policies warn about every action that is clipped.
        warnings.filterwarnings("ignore", message="Constant")
        return roll_out(env, task, seed, act)


def scripted_episodes(
    episodes_per_task: int,
    *,
    tasks: Sequence[str] | None = None,
    obs_type: str = "state",
    seed: int = 0,
    n_workers: int = 2,
    table: str = "paper",
) -> Iterator[TaskEpisode]:
    """
    Collect the same episodes in the same order with any number of workers. The tasks take turns.

    :param episodes_per_task: number of attempts at each task
    :param tasks: the tasks to attempt (default: all of the table)
    :param obs_type: "state", "pixels" or "both"
    :param seed: seed of the whole collection
    :param n_workers: number of processes; 1 collects in this one
    :param table: name of the table
    :return: `episodes_per_task * len(tasks)` episodes
    """
    tasks = find_table(table).tasks if tasks is None else tasks
    check_tasks(tasks, table)
    seeds = np.random.SeedSequence(seed).generate_state(episodes_per_task * len(tasks))
    jobs = [(tasks[i % len(tasks)], int(episode_seed)) for i, episode_seed in enumerate(seeds)]
    run = functools.partial(_episode_in_worker, obs_type, table)
    yield from map_in_order(run, jobs, n_workers)


def collect_scripted(
    path: str | os.PathLike[str],
    *,
    episodes_per_task: int,
    tasks: Sequence[str] | None = None,
    obs_type: str = "state",
    seed: int = 0,
    n_workers: int = 2,
    progress: bool = True,
    mode: Literal["x", "w"] = "x",
    table: str = "paper",
) -> dict[str, float]:
    """
    Collect episodes and write them to one dataset file, which appears when all of them are collected.

    A step's `success` is success at the attempted task, which is the episode's `source`. The file holds no `rewards`, since it
    would mix those of several tasks. Its extras are `task_success`, `task_reward`, `state` and `scene_state` of `TaskEpisode`.

    :param path: path of the file
    :param episodes_per_task: number of attempts at each task
    :param tasks: the tasks to attempt (default: all of the table)
    :param obs_type: "state", "pixels" or "both"
    :param seed: seed of the whole collection
    :param n_workers: number of processes; the file is the same for any number
    :param progress: whether to show a progress bar
    :param mode: "x" refuses an existing file, "w" replaces it
    :param table: name of the table
    :return: for each task the share of its episodes that succeeded at some step
    """
    tasks = find_table(table).tasks if tasks is None else tasks
    check_tasks(tasks, table)
    if episodes_per_task < 1:
        raise ValueError(f"episodes_per_task is {episodes_per_task}; give at least 1")
    n_episodes = episodes_per_task * len(tasks)
    solved = dict.fromkeys(tasks, 0)
    provenance = {
        "program": "sb3_offline.data_tools.collecting.scripted",
        "policy": BEHAVIOUR,
        "seed": seed,
        "episodes_per_task": episodes_per_task,
        "versions": installed_versions(SIMULATION_PACKAGES),
    }
    path = Path(path).expanduser()
    with WriteLock(path) as lock, contextlib.ExitStack() as stack:
        if path.exists() and mode == "x":
            raise DatasetError(path, "file", "exists already", 'Name another file, or replace it with mode="w" (--overwrite)')
        temporary = stack.enter_context(replacing(path, lock))  # a collection that fails or is killed leaves nothing
        writer = stack.enter_context(episode_writer(temporary, obs_type, tasks, n_episodes, provenance, "x", table))
        episodes = scripted_episodes(
            episodes_per_task, tasks=tasks, obs_type=obs_type, seed=seed, n_workers=n_workers, table=table
        )
        for episode in tqdm(episodes, total=n_episodes, desc="collecting", unit="episode", disable=not progress):
            solved[episode.task] += episode.solved
            add_episode(writer, episode)
    return {task: count / episodes_per_task for task, count in solved.items()}
