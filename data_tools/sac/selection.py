"""Select checkpoints of trained SAC agents, measure their success, and write the folder that `collect-sac` reads."""

from __future__ import annotations

import functools
import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from sb3_offline.common.provenance import SIMULATION_PACKAGES, installed_versions
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import replacing
from sb3_offline.data_tools.sac.policies import file_sha256, load_actor
from sb3_offline.data_tools.sac.training import SETTINGS, evaluate_actor, read_curve
from sb3_offline.envs import ENV_ID
from sb3_offline.parallel.processes import map_in_order

MEASURE_SEED = 2_000_000
"""Seed of the first measured episode. Neither the evaluations during training nor the collections use these seeds."""


class _Candidate(NamedTuple):
    task: str
    run: str
    path: Path

    @property
    def step(self) -> int:
        """Number of decisions that the checkpoint was trained for."""
        return int(self.path.stem)

    @property
    def file(self) -> str:
        """Name of the checkpoint's copy."""
        return f"{self.task}_{self.run}_{self.path.name}"


def select_checkpoints(
    runs: Sequence[Path], output: Path, tasks: Sequence[str], n_checkpoints: int, *, n_episodes: int = 300, n_workers: int = 2
) -> Iterator[str]:
    """
    Copy checkpoints of each run and task, with their measured success, into a folder. Checkpoints of other tasks that are
    there already stay.

    :param runs: folders of `train-sac`, which must have different names
    :param output: folder for ``policies.json`` and the weights. It stays whole until every checkpoint is measured.
    :param tasks: some of `TASKS`; those that no run was trained for are left out
    :param n_checkpoints: number of checkpoints of each run and task
    :param n_episodes: number of episodes to measure each checkpoint with
    :param n_workers: number of processes
    :return: a line for the user about each checkpoint, once it is measured; raises ``DatasetError`` if there is none
    """
    names = [run.resolve().name for run in runs]
    if len({*names}) < len(names):
        problem, remedy = (
            f"is not unique among {', '.join(names)}",
            "Checkpoints are named after it: rename one of the folders",
        )
        raise DatasetError(runs[0], "name", problem, remedy)
    folders = {
        task: {name: run / task for name, run in zip(names, runs, strict=True) if (run / task / "curve.csv").exists()}
        for task in tasks
    }
    candidates = [
        _Candidate(task, name, path)
        for task, of_task in folders.items()
        for name, folder in of_task.items()
        for path in choose_checkpoints(folder, n_checkpoints)
    ]
    if not candidates:
        raise DatasetError(runs[0], "curve.csv", "is in no task's folder", "Run sb3-offline train-sac first")
    index = output / "policies.json"
    entries: dict[str, Any] = json.loads(index.read_text())["tasks"] if index.exists() else {}
    before = _files(entries)
    for task in {candidate.task for candidate in candidates}:
        entries[task] = {
            "algorithm": "stable_baselines3.SAC, MlpPolicy, state observations",
            "runs": {name: _provenance(folder) for name, folder in folders[task].items()},
            "checkpoints": [],
        }
    measured = map_in_order(functools.partial(_measure, n_episodes=n_episodes), candidates, n_workers)
    for candidate, successes in zip(candidates, measured, strict=True):
        checkpoint = {"file": candidate.file, "run": candidate.run, "step": candidate.step}
        measurement = {"sha256": file_sha256(candidate.path), "successes": successes, "episodes": n_episodes}
        entries[candidate.task]["checkpoints"].append({**checkpoint, **measurement})
        trained = f"{candidate.task:<12} after {candidate.step:>7} decisions of {candidate.run}"
        yield f"{trained}: {successes} of {n_episodes} solved"
    # Only now, when all are measured: until here, an earlier selection in the folder is whole
    for candidate in candidates:
        with replacing(output / candidate.file) as temporary:
            shutil.copyfile(candidate.path, temporary)
    with replacing(index) as temporary:
        temporary.write_text(json.dumps({"env_id": ENV_ID, "tasks": dict(sorted(entries.items()))}, indent=2) + "\n")
    for name in before - _files(entries):
        (output / name).unlink(missing_ok=True)


def _files(entries: dict[str, Any]) -> set[str]:
    """:return: file names of the checkpoints in an index"""
    return {checkpoint["file"] for entry in entries.values() for checkpoint in entry["checkpoints"]}


def choose_checkpoints(folder: Path, n: int) -> list[Path]:
    """
    :param folder: folder of a task, as train-sac leaves it
    :param n: number of checkpoints
    :return: the checkpoints nearest to n equal parts of the training, the last one among them
    """
    steps = [int(row["step"]) for row in read_curve(folder)]
    places = np.unique(np.ceil(len(steps) * np.arange(1, n + 1) / n).astype(int) - 1)
    return [folder / "policies" / f"{steps[i]:06d}.npz" for i in places]


def _measure(candidate: _Candidate, n_episodes: int) -> int:
    actor = load_actor(candidate.path)
    successes, _ = evaluate_actor(actor, _env(candidate.task), n_episodes, seed=MEASURE_SEED, sample=True)
    return int(successes.sum())


@functools.lru_cache(maxsize=1)
def _env(task: str) -> gym.Env:
    return gym.make(ENV_ID, task=task, obs_type="state")


def _provenance(folder: Path) -> dict[str, Any]:
    curve = read_curve(folder)
    return {
        "settings": SETTINGS[curve[-1]["settings"]],
        "seed": int(curve[-1]["seed"]),
        "trained_decisions": int(curve[-1]["step"]),
        "commit": curve[-1]["commit"],
        "versions": installed_versions([*SIMULATION_PACKAGES, "stable_baselines3", "torch"]),
    }
