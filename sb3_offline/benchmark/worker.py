"""Complete one run of a grid in the current process, whether on this machine or on a cluster."""

import json
import os
import traceback
import warnings
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_offline.benchmark.grid import GridRun
from sb3_offline.common.provenance import TRAINING_PACKAGES, current_commit, installed_versions
from sb3_offline.data.disk import is_full_disk, wait_for_room
from sb3_offline.data.files import lock_file, replacing
from sb3_offline.experiment.run import RunInUseError
from sb3_offline.experiment.training import train_run

FAILURE_FILE, PROVENANCE_FILE, LOCK_FILE = "failure.json", "provenance.json", "lock"
THEN = " then "


def complete_run(run: GridRun) -> None:
    """
    Train a run of a grid, or continue it, unless it is finished. An error in the run is recorded in its folder. A run that
    failed earlier is tried again from its last save.

    :param run: the run; raises ``DatasetError`` if another process is training it
    """
    th.set_num_threads(1)
    run.folder.mkdir(parents=True, exist_ok=True)
    with (run.folder / LOCK_FILE).open("a") as lock:
        lock_file(lock, run.folder)
        lock.truncate(0)
        lock.write(f"{os.getpid()}")  # tells the user which process is training
        lock.flush()
        if run.is_finished():
            (run.folder / FAILURE_FILE).unlink(missing_ok=True)  # a kill may have come before the removal below
            return
        while True:
            try:
                callbacks = [_Provenance(run.folder / PROVENANCE_FILE), *run.tables()]
                train_run(run.training, callbacks=callbacks, progress_bar=False)
            except RunInUseError:
                raise
            except Exception as error:
                if is_full_disk(error, run.folder):  # not a mistake of this run: it goes on from its last save
                    wait_for_room(run.folder)
                    continue
                record_failure(run, f"{type(error).__name__}: {error}", traceback.format_exc())
            else:
                (run.folder / FAILURE_FILE).unlink(missing_ok=True)
            return


def record_failure(run: GridRun, error: str, details: str = "") -> None:
    """
    Record in the folder of a run that it failed.

    :param run: the run
    :param error: short text for the table
    :param details: further information, such as a traceback
    """
    run.folder.mkdir(parents=True, exist_ok=True)
    failure = {"error": " ".join(error.split()), "run": run.training.record(), "traceback": details}
    with replacing(run.folder / FAILURE_FILE) as temporary:
        temporary.write_text(json.dumps(failure, indent=1))


def read_texts(file: Path) -> dict[str, Any]:
    """
    :param file: a JSON file that this module wrote
    :return: its entries; none if there is no such file, or if it is damaged, which is said in a warning
    """
    try:
        found = json.loads(file.read_text()) if file.is_file() else {}
    except (OSError, ValueError) as error:
        found = " ".join(str(error).split())
    if not isinstance(found, dict):
        warnings.warn(f"{file}: is damaged ({found[:200]}) and is ignored.")
        return {}
    return found


class _Provenance(BaseCallback):
    """Records commit and package versions beside a run: several of each if the run continued with other code."""

    def __init__(self, path: Path):
        super().__init__()
        self.path = path

    def _on_training_start(self) -> None:
        versions = ", ".join(f"{name} {version}" for name, version in installed_versions(TRAINING_PACKAGES).items())
        now = {"commit": current_commit(), "versions": versions}
        before = read_texts(self.path) if self.num_timesteps else {}
        for name, earlier in before.items():
            is_same = earlier.split(THEN)[-1] == now[name]
            now[name] = earlier if is_same else earlier + THEN + now[name]
        with replacing(self.path) as temporary:
            temporary.write_text(json.dumps(now))

    def _on_step(self) -> bool:
        return True
