"""
Train stock SB3 SAC from states on each task of the multimodal Meta-World, and keep its actors along the way.

Training proceeds in slices. Each slice loads what the previous one saved and seeds its own random numbers, so that a killed
run continues as if it had never stopped.
"""

from __future__ import annotations

import csv
import functools
import shutil
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

from sb3_offline.common.provenance import current_commit
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import replacing
from sb3_offline.data_tools.sac.policies import SacActor, actor_weights
from sb3_offline.envs import ENV_ID
from sb3_offline.envs.multimodal_metaworld import STATE_NAMES, TASKS
from sb3_offline.envs.multimodal_metaworld.env import EPISODE_LENGTH
from sb3_offline.parallel.processes import map_in_order

SOLVED = 0.9
"""Training stops when this share of the evaluation episodes has been solved twice in a row."""
EVAL_SEED = 1_000_000

_BASE: dict[str, Any] = {
    "learning_rate": 7e-4,
    "batch_size": 256,
    "gamma": 0.97,
    "train_freq": 2,
    "gradient_steps": 1,
    "learning_starts": 2_000,
    "buffer_size": 250_000,
}
_EXPLORE: dict[str, Any] = {**_BASE, "scaled_states": True, "target_entropy": -1.0, "ou_noise": (0.2, 0.01)}
_BOLD: dict[str, Any] = {**_EXPLORE, "target_entropy": 0.0, "ou_noise": (0.2, 1.0)}
SETTINGS: dict[str, dict[str, Any]] = {
    "base": {**_BASE, "policy_kwargs": {"net_arch": [128, 128]}},
    "explore": {**_EXPLORE, "policy_kwargs": {"net_arch": [128, 128]}},
    "bold": {**_BOLD, "policy_kwargs": {"net_arch": [128, 128]}},
    "n_step": {**_BOLD, "n_steps": 3, "train_freq": 1, "learning_rate": 5e-4, "policy_kwargs": {"net_arch": [128, 128]}},
}
"""
Arguments of SAC by name of the setting, and two arguments of this program. With `scaled_states`, the networks see the state
shifted and scaled, while the actors that are kept take the plain state. `ou_noise` holds sigma and dt of the
Ornstein-Uhlenbeck noise on the actions during training.
"""


def train_tasks(
    output: Path,
    tasks: Sequence[str],
    n_timesteps: int,
    *,
    settings: str = "n_step",
    seed: int = 0,
    eval_freq: int = 5_000,
    n_eval_episodes: int = 20,
    n_workers: int = 1,
) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """
    Train an agent for each task, or continue where earlier calls stopped. Progress is printed after every slice.

    :param output: folder. Each task has a folder in it with curve.csv, policies/ and the state to continue from.
    :param tasks: some of `TASKS`
    :param n_timesteps: number of decisions for each task, rounded up to whole slices
    :param settings: one of `SETTINGS`
    :param seed: seed of the runs
    :param eval_freq: number of decisions in a slice, a multiple of the episode length
    :param n_eval_episodes: number of evaluation episodes after each slice
    :param n_workers: number of processes of one thread, which does not change the result
    :return: each task, and the rows of its curve.csv
    """
    if eval_freq < 1 or eval_freq % EPISODE_LENGTH:
        raise ValueError(f"--eval-freq is {eval_freq}; give a multiple of {EPISODE_LENGTH}, whole episodes")
    plan = _Plan(n_timesteps, settings, seed, eval_freq, n_eval_episodes)
    folders = [output / task for task in tasks]
    yield from zip(tasks, map_in_order(functools.partial(_train_task, plan), folders, n_workers), strict=True)


class _Plan(NamedTuple):
    """Arguments of `train_tasks` that are the same for all tasks."""

    n_timesteps: int
    settings: str
    seed: int
    eval_freq: int
    n_eval_episodes: int


def _train_task(plan: _Plan, folder: Path) -> list[dict[str, Any]]:
    """Train one task to its end, from its last saved slice."""
    curve = read_curve(folder)
    first, started = int(curve[-1]["step"]) if curve else 0, time.time()
    while not _is_done(curve, plan.n_timesteps):
        row = _train_slice(folder, plan.settings, plan.seed, plan.eval_freq, plan.n_eval_episodes)
        left = (time.time() - started) * (plan.n_timesteps - row["step"]) / (row["step"] - first) / 60
        print(
            f"{folder.name:<12} {row['step']:>8} decisions: {row['successes']} of {row['episodes']} solved, "
            f"return {row['mean_return']:7.1f}; at most {left:.0f} min left",
            flush=True,
        )
        curve = read_curve(folder)
    return curve


def _is_done(curve: list[dict[str, Any]], step: int) -> bool:
    """:return: True if training reached this number of decisions, or solved the task before"""
    solved = [int(row["successes"]) >= SOLVED * int(row["episodes"]) for row in curve]
    return bool(curve) and (int(curve[-1]["step"]) >= step or solved[-2:] == [True, True])


def read_curve(folder: Path) -> list[dict[str, Any]]:
    """
    :param folder: folder of one task
    :return: rows of its curve.csv, the evaluations so far, as texts
    """
    path = folder / "curve.csv"
    if not path.exists():
        return []
    with path.open() as file:
        return list(csv.DictReader(file))


def _train_slice(folder: Path, settings: str, seed: int, n_decisions: int, n_eval_episodes: int) -> dict[str, Any]:
    """Train the task after which the folder is named for one more slice. The slice counts once curve.csv is written."""
    th.set_num_threads(1)
    th.set_flush_denormal(True)  # Adam's tiny moments slow down the updates otherwise
    began = time.process_time()
    curve = read_curve(folder)
    for name, wanted in (("settings", settings), ("seed", seed)):
        if curve and curve[-1][name] != str(wanted):
            problem, remedy = f"is {curve[-1][name]!r} in this run", f"Continue with it (--{name}), or name another folder"
            raise DatasetError(folder / "curve.csv", name, problem, remedy)
    step = int(curve[-1]["step"]) if curve else 0
    (folder / "policies").mkdir(parents=True, exist_ok=True)
    index = TASKS.index(folder.name)
    plain_env = gym.make(ENV_ID, task=folder.name, obs_type="state")
    arguments = {**SETTINGS[settings], "policy_kwargs": {**SETTINGS[settings]["policy_kwargs"]}}
    offset, scale = _state_scaling(plain_env) if arguments.pop("scaled_states", False) else (0.0, 1.0)
    env: gym.Env = Monitor(plain_env)
    if np.ndim(scale):
        space = gym.spaces.Box(-np.inf, np.inf, np.shape(scale), np.float32)
        env = gym.wrappers.TransformObservation(env, lambda state: ((state - offset) / scale).astype(np.float32), space)
    slice_seed = int(np.random.SeedSequence((seed, index, step)).generate_state(1)[0] >> 1)
    if curve:
        state = folder / f"state_{step}"
        # SB3 warns about n-step returns in a buffer that it creates here, and that is replaced at once
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="`n_steps=")
            model = SAC.load(state / "model.zip", env=env, device="cpu")
        model.load_replay_buffer(state / "replay_buffer.pkl")
        model.set_random_seed(slice_seed)
    else:
        arguments["policy_kwargs"]["optimizer_kwargs"] = {"fused": True}
        sigma, dt = arguments.pop("ou_noise", (0.0, 1.0))
        if sigma:
            arguments["action_noise"] = OrnsteinUhlenbeckActionNoise(np.zeros(4), np.full(4, sigma), dt=dt)
        model = SAC("MlpPolicy", env, seed=slice_seed, device="cpu", **arguments)
    model.learn(n_decisions, reset_num_timesteps=False)
    step += n_decisions

    state_dict = {name: tensor.numpy() for name, tensor in model.actor.state_dict().items()}
    weights = actor_weights(state_dict, offset, scale)
    np.savez(folder / "policies" / f"{step:06d}.npz", **weights)  # type: ignore[arg-type]
    successes, returns = evaluate_actor(SacActor(weights), plain_env, n_eval_episodes)
    row = {
        "step": step,
        "episodes": n_eval_episodes,
        "successes": int(successes.sum()),
        "mean_return": round(float(returns.mean()), 1),
        "ent_coef": round(float(model.log_ent_coef.detach().exp()), 4),  # type: ignore[union-attr]
        "cpu_seconds": round(time.process_time() - began, 1),
        "settings": settings,
        "seed": seed,
        "commit": current_commit(),
    }
    state = folder / f"state_{step}"
    state.mkdir(exist_ok=True)
    model.save(state / "model.zip")
    model.save_replay_buffer(state / "replay_buffer.pkl")
    with replacing(folder / "curve.csv") as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(row), lineterminator="\n")
        writer.writeheader()
        writer.writerows([*curve, row])
    for old in folder.glob("state_*"):
        if old != state:
            shutil.rmtree(old)
    return row


def _state_scaling(env: gym.Env) -> tuple[np.ndarray, np.ndarray]:
    """
    :return: (21,) offset, the initial state with every object at its nominal place; (21,) scale, a decimetre or half a radian
    """
    table: Any = env.unwrapped
    table.scene.reset()
    scale = [0.5 if name.endswith(("angle", "opening")) else 0.1 for name in STATE_NAMES]
    return table.get_state().astype(np.float64), np.array(scale)


def evaluate_actor(
    actor: SacActor, env: gym.Env, n_episodes: int, *, seed: int = EVAL_SEED, sample: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """
    :param actor: an actor of the task that `env` rewards
    :param env: environment with state observations
    :param n_episodes: number of episodes
    :param seed: seed of the first episode; each further one has the next seed
    :param sample: sample the actions instead of playing the most likely ones
    :return: (n_episodes,) bool, solved at some decision; (n_episodes,) float64, sum of rewards
    """
    successes, returns = np.zeros(n_episodes, dtype=bool), np.zeros(n_episodes)
    for i in range(n_episodes):
        rng = np.random.default_rng(seed + i) if sample else None
        observation, _ = env.reset(seed=seed + i)
        truncated = False
        while not truncated:
            observation, reward, _, truncated, info = env.step(actor.act(observation, rng))
            returns[i] += float(reward)
        successes[i] = info["is_success"]
    return successes, returns
