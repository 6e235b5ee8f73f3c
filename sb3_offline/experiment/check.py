"""Check files and folders of any kind that this package writes, in a child process that may crash or hang."""

import contextlib
import csv
import glob
import io
import json
import multiprocessing
import os
import zipfile
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_offline.data.check import Verdict, check_dataset, check_examples, is_dataset_file, is_examples_file
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.pickles import check_model
from sb3_offline.experiment.policy_file import load_policy
from sb3_offline.experiment.run import CONFIG_FILE, MODEL_FILE, PENDING_FILE, RESUME_FILE, read_record

#: Files that a folder of data is searched for
SUFFIXES = (".h5", ".hdf5", ".npz", ".zip")
#: Seconds that a check may take, and bytes for which it gets one second more
SECONDS, BYTES_PER_SECOND = 120, 5_000_000
TRUST = "If you trust its origin, say so: --trust"


def check_all(
    given: Sequence[str], *, trust: bool = False, seconds: float = SECONDS, check_one: Callable[..., Verdict] | None = None
) -> Iterator[Verdict]:
    """
    Check files, folders and patterns. A child process does the work: files can be so damaged that the HDF5 library crashes.

    :param given: datasets, success examples, models, policies, runs, or folders with some of these
    :param trust: open pickles that may run any code
    :param seconds: time that a check may take; large files get more
    :param check_one: the check of one of them (default: :func:`check`)
    :return: the verdict on each, as they arise
    """
    waiting = [place for text in given for place in _expand(text)]
    context = multiprocessing.get_context("spawn")
    while waiting:
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=_work, args=(check_one or check, sender, list(waiting), trust), daemon=True)
        process.start()
        sender.close()
        try:
            receiver.recv()  # it has started
            while waiting:
                if not receiver.poll(seconds + _size(waiting[0]) / BYTES_PER_SECOND):
                    problem = "takes too long to be read"
                    break
                verdict = receiver.recv()
                waiting.pop(0)
                yield verdict
            else:
                break
        except EOFError:
            process.join()
            problem = f"makes the library that reads it crash (exit code {process.exitcode})"
        finally:
            process.kill()
            process.join()
            receiver.close()
        path = waiting.pop(0)
        yield Verdict(path, "", [str(DatasetError(path, "file", problem, "The file is damaged: restore it from a copy"))], [])


def _work(check_one: Callable[..., Verdict], sender: Connection, paths: list[str], trust: bool) -> None:
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):  # warnings of libraries; the verdict says all
        sender.send(None)
        for path in paths:
            sender.send(check_one(path, trust=trust))


def _size(path: str) -> int:
    place = Path(path)
    with contextlib.suppress(OSError):
        return sum(file.stat().st_size for file in place.rglob("*")) if place.is_dir() else place.stat().st_size
    return 0


def _expand(text: str) -> list[str]:
    """:return: the files and runs that a path or a pattern stands for"""
    place = os.path.expanduser(text)
    places = sorted(glob.glob(place, recursive=True)) if glob.has_magic(place) and not os.path.exists(place) else [place]
    found = []
    for path in places or [place]:
        runs = sorted({*map(os.path.dirname, _below(path, {CONFIG_FILE, MODEL_FILE, PENDING_FILE, RESUME_FILE}))})
        found += [*runs, *map(os.fspath, _data_files(Path(path)))] if runs and path not in runs else [path]
    return found


def _below(folder: str, names: set[str]) -> list[str]:
    return [os.path.join(place, name) for place, _, files in os.walk(folder) for name in files if name in names]


def check(path: str, *, trust: bool = False) -> Verdict:
    """
    Check a file or a folder in this process.

    :param path: a dataset, a file of success examples, a model, a policy, or the folder of a run
    :param trust: open pickles that may run any code
    :return: the verdict
    """
    try:
        return _check(Path(path), path, trust)
    except (DatasetError, OSError) as error:
        return Verdict(path, "", [str(error) if isinstance(error, DatasetError) else f"{path}: file: {error}"], [])
    except Exception as error:  # libraries raise errors of any type for damaged files
        problem = f"cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:200]})"
        return Verdict(path, "", [str(DatasetError(path, "file", problem, "Restore it from a copy"))], [])


def _check(place: Path, name: str, trust: bool) -> Verdict:
    if place.is_dir() and any((place / file).is_file() for file in (CONFIG_FILE, MODEL_FILE, PENDING_FILE, RESUME_FILE)):
        return _check_run(place, trust)
    if place.is_file():
        with place.open("rb") as file:
            head = file.read(8)
        if head == b"\x89HDF\r\n\x1a\n" and is_examples_file(place):
            return check_examples(place)
        members = _members(place) if head.startswith(b"PK") else []
        if "data" in members:
            _check_model(place, trust)
            return Verdict(name, "model", [], [])
        if "description.npy" in members:
            load_policy(place)
            return Verdict(name, "policy", [], [])
        if place.suffix == ".npy" or (members and all(member.endswith(".npy") for member in members)):
            loaded = np.load(place, allow_pickle=False)
            if isinstance(loaded, np.ndarray) or {"observations"} >= set(loaded.files):
                arrays = {"array": loaded} if isinstance(loaded, np.ndarray) else {key: loaded[key] for key in loaded.files}
                return Verdict(name, f"arrays {', '.join(f'{key} {array.shape}' for key, array in arrays.items())}", [], [])
    if place.is_dir() and any(map(_is_own, files := _data_files(place))):
        verdicts = [check(os.fspath(file), trust=trust) for file in files]
        damages = [damage for verdict in verdicts for damage in verdict.damages]
        notes = [f"{Path(verdict.path).name}: {note}" for verdict in verdicts for note in verdict.notes]
        return Verdict(name, f"{len(files)} files, none of them damaged", damages, notes)
    return check_dataset(name, trust=trust)


def _data_files(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.iterdir()) if path.suffix in SUFFIXES and path.is_file()]


def _is_own(file: Path) -> bool:
    """:return: whether a file is a dataset or examples of our own format, or an HDF5 file that cannot be opened"""
    try:
        return is_dataset_file(file) or (file.suffix in (".h5", ".hdf5") and is_examples_file(file))
    except DatasetError:
        return True


def _members(path: Path) -> list[str]:
    try:
        with zipfile.ZipFile(path) as archive:
            bad = archive.testzip()
            if bad is not None:
                raise DatasetError(path, bad, "does not match its checksum", "Restore the file from a copy")
            return archive.namelist()
    except (zipfile.BadZipFile, OSError, EOFError, ValueError, NotImplementedError, RuntimeError) as error:
        if isinstance(error, DatasetError):
            raise
        problem = f"is a damaged zip archive ({' '.join(str(error).split())})"
        raise DatasetError(path, "file", problem, "Restore the file from a copy") from error


def _check_model(path: Path, trust: bool) -> None:
    members = _members(path)
    if not trust:
        check_model(path, TRUST)
    with zipfile.ZipFile(path) as archive:
        for name in [name for name in members if name.endswith(".pth")]:
            try:
                th.load(io.BytesIO(archive.read(name)), map_location="cpu", weights_only=not trust)
            except Exception as error:  # damaged pickles raise errors of any type
                problem = f"cannot be loaded ({' '.join(str(error).split())[:200]})"
                raise DatasetError(path, name, problem, "Restore the file from a copy, or train again") from error


def _check_run(folder: Path, trust: bool) -> Verdict:
    """Check a run with all of its files."""
    damages: list[str] = []

    def look(file: Path, check_file: Any) -> None:
        try:
            if file.is_file():
                check_file(file)
        except DatasetError as error:
            damages.append(str(error))

    look(folder / CONFIG_FILE, read_record)
    look(folder / PENDING_FILE, read_record)
    look(folder / MODEL_FILE, lambda file: _check_model(file, trust))
    look(folder / RESUME_FILE, lambda file: _check_model(file, trust))
    for table in sorted(folder.glob("*evaluations*.csv")):
        look(table, _check_table)
    for file in sorted(folder.glob("*.json")):
        look(file, _check_json)
    has_model, has_record = (folder / MODEL_FILE).is_file(), (folder / CONFIG_FILE).is_file()
    if has_model and not has_record:
        remedy = "Restore it from a copy, or train again"
        damages.append(str(DatasetError(folder / CONFIG_FILE, "file", "is missing beside the model", remedy)))
    notes = [] if has_model else ["the run has not ended: there is no model yet; start it again with the same arguments"]
    return Verdict(os.fspath(folder), "run with model, record and tables" if has_model else "unfinished run", damages, notes)


def _check_table(file: Path) -> None:
    try:
        with file.open(newline="", encoding="utf-8") as opened:
            for row in csv.DictReader(opened, strict=True):
                _ = int(row["step"]), int(row["episodes"]), int(row["successes"]), float(row["mean_return"])
    except (ValueError, TypeError, KeyError, csv.Error) as error:
        problem = f"is no table of evaluations ({' '.join(str(error).split())})"
        remedy = "Remove it, and start the run again with the same arguments"
        raise DatasetError(file, "file", problem, remedy) from error


def _check_json(file: Path) -> None:
    try:
        json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DatasetError(file, "file", f"is not JSON ({error})", "Remove it; the next run writes it again") from error
