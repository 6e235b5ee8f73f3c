"""Tools for files: atomic replacement, locks, and HDF5 files whose errors name a remedy."""

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
    :return: a temporary file in the same folder. Its name depends only on ``path``, so that the next writer finds and
        overwrites the file of a killed process
    """
    return path.with_name(f".{path.name}.tmp")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """
    Replace a file in one step. A reader, also one that starts after a kill or a power cut, sees either the old file or the new
    one, and always a complete one.

    :param path: the file to create or replace
    :return: context manager that gives a temporary path to write to. The temporary file replaces ``path`` if the block ends
        without an error, and is deleted otherwise
    """
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_path(path)
    try:
        yield temporary
        _sync(temporary)
        os.replace(temporary, path)
        if os.name == "posix":  # the directory stores the rename; other systems cannot open directories
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
    Lock a file against a second writer, since two writers would destroy each other's work. A process that ends or is killed
    loses its locks.

    :param file: the open file; closing it frees the lock
    :param path: its path, for the error message
    :param wait: wait until another process frees the lock
    :raises DatasetError: if another process holds the lock and ``wait`` is false
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
    Lock a folder in which files are read, changed and replaced. The block waits until no other process is in such a block with
    the same folder.

    :param folder: an existing folder
    :return: context manager; it does not lock on systems that cannot lock folders
    """
    if sys.platform == "win32":  # folders cannot be opened there
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
    :return: the file, opened for reading without HDF5's file lock, so that it can be read while a writer appends to it
    :raises DatasetError: if the file does not exist or is damaged
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
        # This process has the file open with the lock, and HDF5 requires the same setting each time.
        return h5py.File(path, "r", locking=True)
    except OSError as error:
        if "truncated file" in str(error):
            raise DatasetError(path, "file", "is truncated", "Copy or download it again: its end is missing") from error
        problem = "cannot be read as HDF5 (" + str(error).strip() + ")"
        raise DatasetError(path, "file", problem, "Check that this is a complete .h5 or .hdf5 file") from error
