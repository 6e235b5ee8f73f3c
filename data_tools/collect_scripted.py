"""
Demo data for the multimodal Meta-World: the stock scripted policies, with noise, wrong aims and aborted attempts.

These are not the learned agents of the CEBORL paper. They stand in for them: about a third of each task's episodes succeed.
"""

from __future__ import annotations

import functools
import importlib.metadata
import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
from metaworld import policies
from tqdm.auto import tqdm

import sb3_offline.envs  # noqa: F401  (registers the environment)
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.data_tools.workers import map_in_order
from sb3_offline.envs.multimodal_metaworld import TASKS

ENV_ID = "MultimodalMetaworld-v0"
BEHAVIOUR = "stock Meta-World scripted policies with noise, wrong aims and aborted attempts; no learned agents"


class Script(NamedTuple):
    policy: type[policies.policy.Policy]
    gain: float
    """Factor of the stock hand action."""
    n_decisions: int
    """The undisturbed script has solved the task by then; attempts are aborted earlier."""
    noise: tuple[float, float]
    """Range of the action noise that leaves most straight attempts successful."""
    straight: float
    """Share of attempts that go straight, so that a third of all succeed."""
    lets_go: bool = False
    """Whether the stock policy undoes its success, so that the hand has to stop there."""


SCRIPTS = {
    "dial-turn": Script(policies.SawyerDialTurnV3Policy, 1.0, 16, (0.03, 0.2), 0.37),
    "door-open": Script(policies.SawyerDoorOpenV3Policy, 1.0, 20, (0.03, 0.3), 0.28),
    "drawer-open": Script(policies.SawyerDrawerOpenV3Policy, 1.0, 20, (0.03, 0.3), 0.29),
    "lever-pull": Script(policies.SawyerLeverPullV3Policy, 0.5, 36, (0.03, 0.15), 0.34, lets_go=True),
    "plate-slide": Script(policies.SawyerPlateSlideV3Policy, 1.0, 23, (0.03, 0.3), 0.31),
}

# How the other attempts go.
_FAILINGS = {"aborted": 0.55, "misaimed": 0.3, "clumsy": 0.15}
_WORKSPACE_LOW, _WORKSPACE_HIGH = np.array([-0.45, 0.45, 0.08]), np.array([0.6, 0.85, 0.4])


@dataclass(frozen=True)
class ScriptedEpisode:
    """
    T decisions of one attempt at `task`.

    :param task: what was attempted
    :param seed: the episode's own: with the task, it determines every byte
    :param observations: (T + 1, ...) of the environment
    :param actions: (T, 4) float32
    :param task_success: (T, 5) bool, after each decision
    :param task_reward: (T, 5) float32
    :param scene_state: (T, 30) float64, `TableScene.get_state` after each decision, to draw it again to the byte
    """

    task: str
    seed: int
    observations: np.ndarray
    actions: np.ndarray
    task_success: np.ndarray
    task_reward: np.ndarray
    scene_state: np.ndarray


class _Attempt:
    """One episode's behaviour: a stock policy and what disturbs it, all drawn when the attempt begins."""

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
        :param decision: how many were taken before
        :param stock_observation: (39,) for the attempted task
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
        noise = self._noise * self._rng.normal(size=4)
        return np.clip(action + noise, -1.0, 1.0).astype(np.float32)


def _run_episode(env: gym.Env, task: str, seed: int) -> ScriptedEpisode:
    scene_env: Any = env.unwrapped
    index = TASKS.index(task)
    attempt = _Attempt(task, np.random.default_rng((seed, index)))
    observation, _ = env.reset(seed=seed)
    observations = [observation]
    actions: list[np.ndarray] = []
    successes, rewards, states = [], [], []
    solved = truncated = False
    while not truncated:
        action = attempt.act(len(actions), scene_env.stock_observation(task), solved)
        observation, _, _, truncated, info = env.step(action)
        solved = solved or bool(info["task_success"][index])
        observations.append(observation)
        actions.append(action)
        successes.append(info["task_success"])
        rewards.append(info["task_reward"])
        states.append(scene_env.scene.get_state())
    return ScriptedEpisode(task, seed, *map(np.stack, (observations, actions, successes, rewards, states)))


@functools.lru_cache(maxsize=1)
def _shared_env(obs_type: str) -> gym.Env:
    """One environment for all episodes of a process: the tasks share their scene."""
    return gym.make(ENV_ID, obs_type=obs_type)


def _episode_in_worker(obs_type: str, job: tuple[str, int]) -> ScriptedEpisode:
    with warnings.catch_warnings():
        # The stock policies warn of every action that is clipped.
        warnings.filterwarnings("ignore", message="Constant")
        return _run_episode(_shared_env(obs_type), *job)


def _check_tasks(tasks: Sequence[str]) -> None:
    unknown = set(tasks) - set(TASKS)
    if unknown:
        raise ValueError(f"Unknown tasks {sorted(unknown)}; choose from {', '.join(TASKS)}.")


def scripted_episodes(
    episodes_per_task: int,
    *,
    tasks: Sequence[str] = TASKS,
    obs_type: str = "state",
    seed: int = 0,
    n_workers: int = 2,
) -> Iterator[ScriptedEpisode]:
    """
    The same episodes in the same order for any number of workers, the tasks taking turns.

    :param episodes_per_task: how many attempts at each task
    :param tasks: which of `TASKS` to attempt
    :param obs_type: "state" or "pixels"
    :param seed: of the whole collection
    :param n_workers: processes; 1 collects in this one
    :return: `episodes_per_task * len(tasks)` episodes
    """
    _check_tasks(tasks)
    seeds = np.random.SeedSequence(seed).generate_state(episodes_per_task * len(tasks))
    jobs = [(tasks[i % len(tasks)], int(episode_seed)) for i, episode_seed in enumerate(seeds)]
    run = functools.partial(_episode_in_worker, obs_type)
    yield from map_in_order(run, jobs, n_workers)


def collect_scripted(
    path: str | os.PathLike[str],
    *,
    episodes_per_task: int,
    tasks: Sequence[str] = TASKS,
    obs_type: str = "state",
    seed: int = 0,
    n_workers: int = 2,
    progress: bool = True,
    mode: Literal["x", "w"] = "x",
) -> dict[str, float]:
    """
    Collect episodes and write them to one dataset file.

    A step's `success` is that of the attempted task, which is the episode's `source`; the file holds no `rewards`, since those
    of five tasks would be mixed in it. Extras: `task_success`, `task_reward` and `scene_state` of `ScriptedEpisode`.

    :param path: of the file
    :param episodes_per_task: how many attempts at each task
    :param tasks: which of `TASKS` to attempt
    :param obs_type: "state" or "pixels"
    :param seed: of the whole collection
    :param n_workers: processes; the file is the same for any number
    :param progress: whether to show a progress bar
    :param mode: "x" refuses an existing file, "w" replaces it
    :return: for each task the share of its episodes that succeeded at some step
    """
    _check_tasks(tasks)
    env = _shared_env(obs_type)
    n_episodes = episodes_per_task * len(tasks)
    n_steps = n_episodes * env.unwrapped.episode_length  # type: ignore[attr-defined]
    solved = dict.fromkeys(tasks, 0)
    provenance = {
        "program": "sb3_offline.data_tools.collect_scripted",
        "policy": BEHAVIOUR,
        "seed": seed,
        "episodes_per_task": episodes_per_task,
        "versions": {name: importlib.metadata.version(name) for name in ("metaworld", "mujoco", "gymnasium", "numpy")},
    }
    with DatasetWriter(
        path,
        env.observation_space,
        env.action_space,
        env_id=ENV_ID,
        env_kwargs={"obs_type": obs_type},
        provenance=provenance,
        mode=mode,
        rewards=False,
        extras={"task_success": ((5,), "bool"), "task_reward": ((5,), "float32"), "scene_state": ((30,), "float64")},
        sources=list(tasks),
        capacity=(n_episodes, n_steps),
    ) as writer:
        episodes = scripted_episodes(episodes_per_task, tasks=tasks, obs_type=obs_type, seed=seed, n_workers=n_workers)
        for episode in tqdm(episodes, total=n_episodes, desc="collecting", unit="episode", disable=not progress):
            success = episode.task_success[:, TASKS.index(episode.task)]
            solved[episode.task] += bool(success.any())
            writer.add_episode(
                episode.observations,
                episode.actions,
                success=success,
                extras={
                    "task_success": episode.task_success,
                    "task_reward": episode.task_reward,
                    "scene_state": episode.scene_state,
                },
                seed=episode.seed,
                source=episode.task,
            )
    return {task: count / episodes_per_task for task, count in solved.items()}
