"""Files replaced whole or not at all, and HDF5 files opened with errors that name the remedy."""

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py

from sb3_offline.data.errors import DatasetError


def temporary_path(path: Path) -> Path:
    """
    :param path: the file that is to be written
    :return: its temporary neighbour; always the same, so that what a killed process left is found and overwritten
    """
    return path.with_name(f".{path.name}.tmp")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """
    Write a file so that a reader, or a process started after a kill or a power cut, sees the old or the new one whole.

    :param path: the file to create or replace
    :return: context manager giving the temporary path to write to; it replaces ``path`` when the block ends well
    """
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_path(path)
    try:
        yield temporary
        _sync(temporary)
        os.replace(temporary, path)
        if os.name == "posix":  # the rename itself lives in the directory, which other systems cannot open
            _sync(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def lock_file(file: Any, path: Path, *, wait: bool = False) -> None:
    """
    Refuse a second writer: two would write over each other's work. The lock goes with the process, also when killed.

    :param file: open; closing it frees the lock
    :param path: for the ``DatasetError`` that is raised where another process holds it
    :param wait: wait for that process instead
    """
    if sys.platform == "win32":
        return
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        remedy = "Wait until it is done, or write to another file"
        raise DatasetError(path, "file", "is being written by another process", remedy) from error
    except OSError:  # some network file systems have no locks
        pass


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """
    Wait for whoever else is in this block with the same folder: for files that are read, changed and replaced.

    :param folder: an existing one
    :return: context manager; without a lock where the system has none for folders
    """
    if sys.platform == "win32":  # where folders cannot be opened
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        lock_file(descriptor, folder, wait=True)
        yield
    finally:
        os.close(descriptor)


def open_hdf5(path: str | os.PathLike) -> h5py.File:
    """
    :param path: an HDF5 file
    :return: the file opened for reading, without HDF5's file lock: a dataset may be read while a writer appends to it
    """
    if not os.path.isfile(path):
        raise DatasetError(path, "file", "does not exist", "Check the path")
    try:
        for locking in (False, None):
            try:
                return h5py.File(path, "r", locking=locking)
            except OSError as error:
                if "file locking" not in str(error):
                    raise
        # This process has it open with the lock, and HDF5 wants all openings alike.
        return h5py.File(path, "r", locking=True)
    except OSError as error:
        if "truncated file" in str(error):
            raise DatasetError(path, "file", "is truncated", "Copy or download it again: its end is missing") from error
        problem = "cannot be read as HDF5 (" + str(error).strip() + ")"
        raise DatasetError(path, "file", problem, "Check that this is a complete .h5 or .hdf5 file") from error
