"""
Train stock SB3 SAC on each task of the multimodal Meta-World, from states, and keep its actors along the way.

Training proceeds in slices. Each slice begins by loading what the previous one saved, with random numbers of its own, so
that a run that was killed goes on as if nothing had happened.
"""

from __future__ import annotations

import argparse
import csv
import functools
import shutil
import time
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

from sb3_offline.common.provenance import current_commit
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import replacing
from sb3_offline.data_tools.sac_policies import SacActor, actor_weights
from sb3_offline.data_tools.workers import map_in_order
from sb3_offline.envs import ENV_ID
from sb3_offline.envs.multimodal_metaworld import STATE_NAMES, TASKS
from sb3_offline.envs.multimodal_metaworld.env import EPISODE_LENGTH

SOLVED = 0.9
"""Training stops when this share of evaluation episodes has been reached twice in a row."""
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
Arguments of SAC by name, and two of this program: `scaled_states`, whether the networks see the state shifted and scaled (the
actors that are kept take it as it is); `ou_noise`, sigma and dt of Ornstein-Uhlenbeck noise on the actions while training.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: gets the options of ``run``"""
    parser.add_argument(
        "output", type=Path, help="folder: one per task in it, with curve.csv, policies/ and the state to go on from"
    )
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument(
        "-n", "--n-timesteps", type=int, default=200_000, help="decisions of each task, rounded up to whole slices"
    )
    parser.add_argument("--settings", choices=list(SETTINGS), default="n_step")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--eval-freq", type=int, default=5_000, help="decisions of a slice: whole episodes of 50 (default: 5000)"
    )
    parser.add_argument("--eval-episodes", type=int, default=20, help="after every slice")
    parser.add_argument(
        "--workers", type=int, default=1, help="processes of one thread; the result is the same for any number"
    )


def run(args: argparse.Namespace) -> None:
    """:param args: what ``add_arguments`` asks for"""
    if args.eval_freq < 1 or args.eval_freq % EPISODE_LENGTH:
        raise ValueError(f"--eval-freq is {args.eval_freq}; give a multiple of {EPISODE_LENGTH}, whole episodes")
    train = functools.partial(_train_task, args)
    folders = [args.output / task for task in args.tasks]
    for folder, curve in zip(folders, map_in_order(train, folders, args.workers), strict=True):
        best = max(curve, key=lambda row: int(row["successes"]))
        print(f"{folder.name:<12} best after {best['step']} decisions: {best['successes']} of {best['episodes']} solved")


def _train_task(args: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Train one task to its end, from wherever it is."""
    curve = read_curve(folder)
    first, started = int(curve[-1]["step"]) if curve else 0, time.time()
    while not _is_done(curve, args.n_timesteps):
        row = _train_slice(folder, args.settings, args.seed, args.eval_freq, args.eval_episodes)
        left = (time.time() - started) * (args.n_timesteps - row["step"]) / (row["step"] - first) / 60
        print(
            f"{folder.name:<12} {row['step']:>8} decisions: {row['successes']} of {row['episodes']} solved, "
            f"return {row['mean_return']:7.1f}; at most {left:.0f} min left",
            flush=True,
        )
        curve = read_curve(folder)
    return curve


def _is_done(curve: list[dict[str, Any]], step: int) -> bool:
    """Whether training reached so many decisions, or solved the task before."""
    solved = [int(row["successes"]) >= SOLVED * int(row["episodes"]) for row in curve]
    return bool(curve) and (int(curve[-1]["step"]) >= step or solved[-2:] == [True, True])


def read_curve(folder: Path) -> list[dict[str, Any]]:
    """
    :param folder: of one task
    :return: its evaluations so far, as texts
    """
    path = folder / "curve.csv"
    if not path.exists():
        return []
    with path.open() as file:
        return list(csv.DictReader(file))


def _train_slice(folder: Path, settings: str, seed: int, n_decisions: int, n_eval_episodes: int) -> dict[str, Any]:
    """Train the task that the folder is named after for one more slice; the new curve.csv makes the slice count."""
    th.set_num_threads(1)
    th.set_flush_denormal(True)  # else, Adam's tiny moments slow the updates down
    began = time.process_time()
    curve = read_curve(folder)
    for name, wanted in (("settings", settings), ("seed", seed)):
        if curve and curve[-1][name] != str(wanted):
            problem, remedy = f"is {curve[-1][name]!r} in this run", f"Go on with it (--{name}), or name another folder"
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
        # SB3 warns of the n-step returns of a buffer that it makes here, which is replaced at once
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
    :return: (21,) the state at the start with everything at its nominal place; (21,) a decimetre, or half a radian
    """
    table: Any = env.unwrapped
    table.scene.reset()
    scale = [0.5 if name.endswith(("angle", "opening")) else 0.1 for name in STATE_NAMES]
    return table.get_state().astype(np.float64), np.array(scale)


def evaluate_actor(
    actor: SacActor, env: gym.Env, n_episodes: int, *, seed: int = EVAL_SEED, sample: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """
    :param actor: of the task that `env` rewards
    :param env: with state observations
    :param n_episodes: how many, of the seeds that begin at `seed`
    :param sample: whether actions are sampled, rather than the most likely ones
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
