"""Choose checkpoints of trained SAC agents, measure how often they succeed, and leave them as `collect-sac` takes them."""

from __future__ import annotations

import argparse
import functools
import importlib.metadata
import json
import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import replacing
from sb3_offline.data_tools.rollout import versions
from sb3_offline.data_tools.sac_policies import file_sha256, load_actor
from sb3_offline.data_tools.train_sac import SETTINGS, evaluate_actor, read_curve
from sb3_offline.data_tools.workers import map_in_order
from sb3_offline.envs import ENV_ID
from sb3_offline.envs.multimodal_metaworld import TASKS

MEASURE_SEED = 2_000_000
"""Episodes that neither training's evaluation nor the collection uses."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: gets the options of ``run``"""
    parser.add_argument("runs", nargs="+", type=Path, help="folders of train-sac")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for policies.json and the weights")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS), help="those of other tasks there stay")
    parser.add_argument("--checkpoints", type=int, default=6, help="of each run and task (default: 6)")
    parser.add_argument("--episodes", type=int, default=300, help="to measure each one with (default: 300)")
    parser.add_argument("--workers", type=int, default=2)


def run(args: argparse.Namespace) -> None:
    """:param args: what ``add_arguments`` asks for"""
    names = [run.resolve().name for run in args.runs]
    if len({*names}) < len(names):
        remedy = "Checkpoints are named after it: rename one of the folders"
        raise DatasetError(args.runs[0], "name", f"is not the only one of {', '.join(names)}", remedy)
    folders = {
        task: {name: run / task for name, run in zip(names, args.runs, strict=True) if (run / task / "curve.csv").exists()}
        for task in args.tasks
    }
    jobs = [
        (task, name, path)
        for task, runs in folders.items()
        for name, folder in runs.items()
        for path in choose_checkpoints(folder, args.checkpoints)
    ]
    if not jobs:
        raise DatasetError(args.runs[0], "curve.csv", "is in no task's folder", "Run sb3-offline train-sac first")
    index = args.output / "policies.json"
    tasks: dict[str, Any] = json.loads(index.read_text())["tasks"] if index.exists() else {}
    before = _files(tasks)
    for task in {task for task, _, _ in jobs}:
        tasks[task] = {
            "algorithm": "stable_baselines3.SAC, MlpPolicy, state observations",
            "runs": {name: _provenance(folder) for name, folder in folders[task].items()},
            "checkpoints": [],
        }
    sources = {}
    measured = map_in_order(functools.partial(_measure, n_episodes=args.episodes), jobs, args.workers)
    for (task, run_name, path), successes in zip(jobs, measured, strict=True):
        checkpoint = {"file": f"{task}_{run_name}_{path.name}", "run": run_name, "step": int(path.stem)}
        sources[checkpoint["file"]] = path
        measurement = {"sha256": file_sha256(path), "successes": successes, "episodes": args.episodes}
        tasks[task]["checkpoints"].append({**checkpoint, **measurement})
        print(
            f"{task:<12} after {int(path.stem):>7} decisions of {run_name}: {successes} of {args.episodes} solved", flush=True
        )
    # Not before all are measured: until here, an earlier export is whole
    for name, path in sources.items():
        with replacing(args.output / name) as temporary:
            shutil.copyfile(path, temporary)
    with replacing(index) as temporary:
        temporary.write_text(json.dumps({"env_id": ENV_ID, "tasks": dict(sorted(tasks.items()))}, indent=2) + "\n")
    for name in before - _files(tasks):
        (args.output / name).unlink(missing_ok=True)


def _files(tasks: dict[str, Any]) -> set[str]:
    """:return: names of the checkpoints in an index"""
    return {checkpoint["file"] for entry in tasks.values() for checkpoint in entry["checkpoints"]}


def choose_checkpoints(folder: Path, n: int) -> list[Path]:
    """
    :param folder: of a task, as train-sac leaves it
    :param n: how many
    :return: of its checkpoints, those nearest to n equal parts of the training, the last one among them
    """
    steps = [int(row["step"]) for row in read_curve(folder)]
    places = np.unique(np.ceil(len(steps) * np.arange(1, n + 1) / n).astype(int) - 1)
    return [folder / "policies" / f"{steps[i]:06d}.npz" for i in places]


def _measure(job: tuple[str, str, Path], n_episodes: int) -> int:
    task, _, path = job
    successes, _ = evaluate_actor(load_actor(path), _env(task), n_episodes, seed=MEASURE_SEED, sample=True)
    return int(successes.sum())


@functools.lru_cache(maxsize=1)
def _env(task: str) -> gym.Env:
    return gym.make(ENV_ID, task=task, obs_type="state")


def _provenance(folder: Path) -> dict[str, Any]:
    curve = read_curve(folder)
    learners = {name: importlib.metadata.version(name) for name in ("stable_baselines3", "torch")}
    return {
        "settings": SETTINGS[curve[-1]["settings"]],
        "seed": int(curve[-1]["seed"]),
        "trained_decisions": int(curve[-1]["step"]),
        "commit": curve[-1]["commit"],
        "versions": {**versions(), **learners},
    }
