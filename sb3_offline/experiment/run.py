"""The description of one training run, and its record on the disk."""

import contextlib
import json
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import WriteLock
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.experiment.data import given_data

MODEL_FILE, CONFIG_FILE = "model.zip", "config.yml"
# Record of a run that is to replace a finished one, whose files stay until the new model is whole.
PENDING_FILE = "config.pending.yml"
# Everything that a killed run needs to continue.
RESUME_FILE = "resume.zip"


class RunInUseError(DatasetError):
    """Another process trains in the folder of the run."""


@contextlib.contextmanager
def locked_run(folder: Path) -> Iterator[None]:
    """
    Lock the folder of a run, since two runs would mix their files. A folder in which nothing is written is removed again.

    :param folder: the folder, which is created
    :raises RunInUseError: if another process trains in it
    :raises DatasetError: if it cannot be written to
    """
    created = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        lock = WriteLock(folder / "run")
    except DatasetError as error:
        if not isinstance(error.__cause__, BlockingIOError):
            raise
        problem = error.problem.replace("being written by", "in use by")
        remedy = "Wait until that run has ended, or name another folder"
        raise RunInUseError(folder, "folder", problem, remedy) from error
    try:
        yield
    finally:
        lock.release()
        with contextlib.suppress(OSError):  # not empty
            for place in created:
                place.rmdir()


@dataclass(frozen=True)
class TrainingRun:
    """
    What is trained, on which data, and where its files go.

    The last three parameters change what is evaluated and saved on the way, but not what is learned, so :meth:`record` leaves
    them out.

    :param algo: name in :data:`sb3_offline.ALGOS`
    :param env_id: environment to evaluate in
    :param config: hyperparameters, as :func:`~sb3_offline.experiment.config.load_config` returns them
    :param output: folder for the files of the run
    :param dataset: dataset path(s) (default: those of the config)
    :param examples: success examples, for the algorithms that learn from them (default: those of the config)
    :param env_kwargs: keyword arguments of the environment, in addition to those of the config
    :param seed: seed of the run
    :param eval_freq: gradient steps between evaluations (0 or less: no evaluations)
    :param n_eval_episodes: number of episodes in each evaluation
    :param save_freq: gradient steps between two saves of everything that the run needs to continue (0: no saves)
    """

    algo: str
    env_id: str
    config: dict[str, Any]
    output: Path
    dataset: Any = None
    examples: Any = None
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    seed: int = 0
    eval_freq: int = 0
    n_eval_episodes: int = 20
    save_freq: int = 0

    def record(self) -> dict[str, Any]:
        """
        Describe the run in JSON types. Two runs with the same record learn the same.

        :return: the content of ``config.yml`` in the folder of the run
        """
        env_kwargs = {**self.config.get("env_kwargs", {}), **self.env_kwargs}
        described = {"algo": self.algo, "env": self.env_id, **self.config, "env_kwargs": env_kwargs, "seed": self.seed}
        described |= given_data(self.dataset, self.examples)
        # Through JSON: paths and NumPy numbers become types that a YAML file can hold.
        return json.loads(json.dumps(described, default=_identifier))

    def is_recorded(self) -> bool:
        """:return: True if the folder belongs to a run with the same record"""
        return recorded_run(self.output) == self.record()

    def is_finished(self) -> bool:
        """:return: True if the folder holds the trained model of this run"""
        is_replaced = (self.output / PENDING_FILE).is_file()
        return (self.output / MODEL_FILE).is_file() and not is_replaced and self.is_recorded()


def recorded_run(output: Path) -> dict[str, Any] | None:
    """
    :param output: folder of a run
    :return: the content of its ``config.yml``, or of the record of a run that is to replace it; ``None`` if there is no such
        file, or if it is damaged, which is said in a warning
    """
    pending = output / PENDING_FILE
    config_file = pending if pending.is_file() else output / CONFIG_FILE
    if not config_file.is_file():
        return None
    try:
        return read_record(config_file)
    except DatasetError as error:
        warnings.warn(f"{config_file}: {error.problem}, so the run starts from the beginning.")
        return None


def read_record(file: Path) -> dict[str, Any]:
    """
    :param file: the ``config.yml`` of a run
    :return: its content
    :raises DatasetError: if it is damaged
    """
    try:
        record = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        record = " ".join(str(error).split())
    if not isinstance(record, dict) or not {"algo", "env", "env_kwargs"} <= record.keys():
        problem = f"is damaged ({str(record)[:200]})"
        raise DatasetError(file, "file", problem, "Restore it from a copy, or train again")
    return record


def _identifier(value: Any) -> str:
    """:return: a text that identifies a value, also in another process"""
    if isinstance(value, OfflineDataset):
        return f"{value.path}, {value.n_episodes} episodes, {zlib.crc32(value.actions.tobytes()):08x}"
    if isinstance(value, np.ndarray):
        return f"array {value.shape}, {value.dtype}, {zlib.crc32(value.tobytes()):08x}"
    return f"{value.__module__}.{value.__qualname__}" if callable(value) and hasattr(value, "__qualname__") else str(value)
