"""One run of a grid, in a process of its own: on this machine or on a cluster."""

import importlib.metadata
import json
import os
import traceback
from pathlib import Path

import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_offline.benchmark.grid import Run
from sb3_offline.common.provenance import current_commit
from sb3_offline.data.files import lock_file, replacing
from sb3_offline.experiment.training import train

FAILURE_FILE, PROVENANCE_FILE, LOCK_FILE = "failure.json", "provenance.json", "lock"
THEN = " then "
_PACKAGES = ("torch", "stable_baselines3", "gymnasium", "numpy", "metaworld", "mujoco")


def train_run(run: Run) -> None:
    """
    Train a run of a grid, or go on with it, unless it is finished. What goes wrong in it is written down in its folder; a run
    that failed before is tried again, from its last save on.

    :param run: what to do; raises ``DatasetError`` where another process is at it
    """
    th.set_num_threads(1)
    run.folder.mkdir(parents=True, exist_ok=True)
    with (run.folder / LOCK_FILE).open("a") as lock:
        lock_file(lock, run.folder)
        lock.truncate(0)
        lock.write(f"{os.getpid()}")  # for whoever wonders what is at it
        lock.flush()
        if run.is_finished():
            (run.folder / FAILURE_FILE).unlink(missing_ok=True)  # left by a kill between the two
            return
        try:
            callbacks = [_Provenance(run.folder / PROVENANCE_FILE), *run.tables()]
            train(**run.arguments, callbacks=callbacks, save_freq=run.grid.save_freq, progress_bar=False)
        except Exception as error:
            record_failure(run, f"{type(error).__name__}: {error}", traceback.format_exc())
        else:
            (run.folder / FAILURE_FILE).unlink(missing_ok=True)


def record_failure(run: Run, error: str, details: str = "") -> None:
    """
    :param run: that failed
    :param error: what the table is to say
    :param details: what else might help
    """
    run.folder.mkdir(parents=True, exist_ok=True)
    failure = {"error": " ".join(error.split()), "run": run.record(), "traceback": details}
    with replacing(run.folder / FAILURE_FILE) as temporary:
        temporary.write_text(json.dumps(failure, indent=1))


class _Provenance(BaseCallback):
    """Leaves beside a run which code made it: of each commit, where a run went on with another one."""

    def __init__(self, path: Path):
        super().__init__()
        self.path = path

    def _on_training_start(self) -> None:
        now = {"commit": current_commit(), "versions": versions()}
        before = json.loads(self.path.read_text()) if self.num_timesteps and self.path.is_file() else {}
        for name, earlier in before.items():
            is_same = earlier.split(THEN)[-1] == now[name]
            now[name] = earlier if is_same else earlier + THEN + now[name]
        with replacing(self.path) as temporary:
            temporary.write_text(json.dumps(now))

    def _on_step(self) -> bool:
        return True


def versions() -> str:
    """:return: of the packages that decide what comes out"""
    installed = []
    for name in _PACKAGES:
        try:
            installed.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    return ", ".join(installed)
