"""Tools for files: atomic replacement, locks, and HDF5 files whose errors name a remedy."""

import contextlib
import itertools
import os
import re
import shutil
import socket
import sys
import time
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import h5py

from sb3_offline.data.errors import DatasetError

_HEAD_BYTES = 1 << 16


class WriteLock:
    """
    The right to write a file, which one writer has at a time, also while the file is replaced.

    The lock is a lock of the operating system on a file beside the file to write, ``.NAME.lock``, which no writer replaces. A
    process that ends or is killed loses it. The lock file names its holder for those who are refused, and it is removed when
    the lock is released. The lock file of a killed process stays and is taken over.

    :param path: the file to write; it need not exist
    :param wait: wait until another writer releases the lock
    :raises DatasetError: if another writer has the lock and ``wait`` is false, or if the folder cannot be written to
    """

    def __init__(self, path: Path, *, wait: bool = False):
        self.path = Path(os.path.realpath(path))
        self.lock_path = self.path.with_name(f".{_short(self.path.name)}.lock")
        self._pid = os.getpid()
        self._descriptor = -1
        if self.path.is_dir():
            raise DatasetError(self.path, "file", "is a folder", "Name a file")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._acquire(wait)
        except OSError as error:
            problem = f"cannot be written ({error.strerror or error})"
            raise DatasetError(self.path, "file", problem, "Check the folder and its permissions, or name another") from error

    def _acquire(self, wait: bool) -> None:
        while True:
            flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
            descriptor = os.open(self.lock_path, flags, 0o666)
            try:
                lock_file(descriptor, self.path, wait=wait)
                # The lock file may have been removed by its holder between the two calls.
                if os.path.exists(self.lock_path) and os.path.samestat(os.fstat(descriptor), os.stat(self.lock_path)):
                    holder = f"process {os.getpid()} on {socket.gethostname()} since {time.strftime('%Y-%m-%d %H:%M:%S')}"
                    os.ftruncate(descriptor, 0)
                    os.write(descriptor, holder.encode())
                    self._descriptor, descriptor = descriptor, -1
                    return
            except FileNotFoundError:  # removed between these two calls
                pass
            finally:
                if descriptor >= 0:
                    os.close(descriptor)

    def release(self) -> None:
        """Let other writers write the file. Further calls do nothing, and neither do calls in a forked process."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor < 0:
            return
        try:
            if self._pid == os.getpid():
                with contextlib.suppress(OSError):  # on Windows, an open file cannot be removed: it stays, empty of a lock
                    if os.path.samestat(os.fstat(descriptor), os.stat(self.lock_path)):
                        self.lock_path.unlink()
                _unlock(descriptor)  # explicitly, since forked processes have copies of the descriptor
        finally:
            os.close(descriptor)

    def __del__(self) -> None:
        if hasattr(self, "_descriptor"):
            self.release()

    def __enter__(self) -> "WriteLock":
        return self

    def __exit__(self, *exc_info: Any) -> None:
        self.release()


def _short(name: str) -> str:
    """:return: the name, or a short one in its place that leaves room for a prefix and a suffix"""
    encoded = os.fsencode(name)
    return name if len(encoded) <= 180 else f"{name[:40]}.{zlib.crc32(encoded):08x}"


def remove_leftovers(path: Path) -> None:
    """
    Remove temporary files that killed writers left.

    :param path: the file that they were to replace; the caller holds its lock, so no other writer is alive
    """
    unique = r"\d+\.[0-9a-f]{8}\."
    # A temporary file that a DatasetWriter wrote may have had a lock file and temporary files itself.
    pattern = re.compile(r"\.{1,2}" + re.escape(_short(path.name)) + rf"\.({unique})?tmp(\.({unique}tmp|lock))?")
    with os.scandir(path.parent) as entries:
        leftovers = [entry.path for entry in entries if pattern.fullmatch(entry.name)]
    for leftover in leftovers:
        with contextlib.suppress(OSError):
            os.unlink(leftover)


@contextlib.contextmanager
def replacing(path: Path, lock: WriteLock | None = None) -> Iterator[Path]:
    """
    Replace a file in one step. A reader, also one that starts after a kill or a power cut, sees either the old file or the new
    one, and always a complete one. The new file has the permissions of the old one.

    :param path: the file to create or replace
    :param lock: the lock of the file, if the caller holds it; by default, the block waits for the lock
    :return: context manager that gives a temporary path to write to, in the same folder and with a name of its own. The
        temporary file replaces ``path`` if the block ends without an error, and is deleted otherwise
    """
    path = Path(os.path.realpath(path))
    with WriteLock(path, wait=True) if lock is None else contextlib.nullcontext(lock):
        remove_leftovers(path)
        temporary = path.with_name(f".{_short(path.name)}.{os.getpid()}.{os.urandom(4).hex()}.tmp")
        try:
            yield temporary
            _sync(temporary)
            if path.exists():
                shutil.copymode(path, temporary)
            os.replace(temporary, path)
            if os.name == "posix":  # the directory stores the rename; other systems cannot open directories
                _sync(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


def check_outputs(outputs: Iterable[str | os.PathLike], inputs: Iterable[Any]) -> None:
    """
    Refuse to write over a file that is read, whatever names it is given: links to a file, and names that differ in case on
    some systems, are the same file.

    :param outputs: paths of the files to write
    :param inputs: paths of the files to read, or of folders with such files; other objects, such as arrays, are no files
    :raises DatasetError: if an output is one of the inputs, or a file in a folder that is one of them
    """
    existing = [Path(output).expanduser() for output in outputs if os.path.exists(os.path.expanduser(output))]
    if not existing:
        return
    read: dict[tuple[int, int], Any] = {}
    for given in inputs:
        if isinstance(given, str | os.PathLike):
            place = os.path.expanduser(given)
            below = (os.path.join(folder, name) for folder, _, names in os.walk(place) for name in names)
            for file in itertools.chain([place], below):
                with contextlib.suppress(OSError):
                    status = os.stat(file)
                    read.setdefault((status.st_dev, status.st_ino), file)
    for output in existing:
        status = os.stat(output)
        origin = read.get((status.st_dev, status.st_ino))
        if origin is not None:
            raise DatasetError(output, "file", f"is read by this very command (as {origin})", "Name another file to write")


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

    :param file: the open file, or its descriptor; closing it frees the lock
    :param path: the path for the error message
    :param wait: wait until another process frees the lock
    :raises DatasetError: if another process holds the lock and ``wait`` is false
    """
    descriptor = file if isinstance(file, int) else file.fileno()
    try:
        _lock(descriptor, wait)
    except BlockingIOError as error:
        holder = ""
        with contextlib.suppress(OSError):
            os.lseek(descriptor, 0, os.SEEK_SET)
            holder = os.read(descriptor, 200).decode(errors="replace")
        known = f" ({holder})" if holder.startswith("process ") else ""
        remedy = "Wait until it is done, or write to another file"
        raise DatasetError(path, "file", f"is being written by another process{known}", remedy) from error


if sys.platform == "win32":
    import msvcrt

    _LOCKED_BYTE = 1 << 30  # beyond the contents, which others may read: locks are mandatory there

    def _lock(descriptor: int, wait: bool) -> None:
        while True:
            os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
            try:
                msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
                break
            except OSError as error:
                if not wait:
                    raise BlockingIOError(*error.args) from error
                time.sleep(0.01)
        os.lseek(descriptor, 0, os.SEEK_SET)

    def _unlock(descriptor: int) -> None:
        with contextlib.suppress(OSError):
            os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_UNLCK, 1)

else:
    import fcntl

    def _lock(descriptor: int, wait: bool) -> None:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError:  # some network file systems have no locks
            pass

    def _unlock(descriptor: int) -> None:
        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_UN)


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
    _check_heaps(path)
    try:
        for locking in (False, None):
            try:
                return h5py.File(path, "r", locking=locking)
            except OSError as error:
                if "file locking" not in str(error):
                    raise
        # This process has the file open with the lock, and HDF5 requires the same setting each time.
        return h5py.File(path, "r", locking=True)
    except FileNotFoundError as error:  # removed in this moment
        raise DatasetError(path, "file", "does not exist", "Check the path") from error
    except OSError as error:
        if "truncated file" in str(error):
            raise DatasetError(path, "file", "is truncated", "Copy or download it again: its end is missing") from error
        problem = "cannot be read as HDF5 (" + str(error).strip() + ")"
        raise DatasetError(path, "file", problem, "Check that this is a complete .h5 or .hdf5 file") from error


def _check_heaps(path: str | os.PathLike) -> None:
    """
    Refuse a file that HDF5 would read for ever: it takes the objects of a heap, in which texts are, one after the other, and
    does not advance where a free one has no size. A block of zeros, which a disk left, looks like that.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(_HEAD_BYTES)  # texts are written first; a heap behind this is not checked
    except OSError:  # HDF5 says what is wrong
        return
    start = head.find(b"GCOL\x01")
    while start >= 0:
        end = min(start + int.from_bytes(head[start + 8 : start + 16], "little"), len(head))
        place = start + 16
        while place + 16 <= end:
            size = int.from_bytes(head[place + 8 : place + 16], "little")
            if head[place : place + 2] != b"\0\0":
                size = 16 + -(-size // 8) * 8
            if size == 0:
                problem = f"holds a damaged heap of texts (at byte {place})"
                raise DatasetError(path, "file", problem, "Restore the file from a copy, or download it again")
            place += size
        start = head.find(b"GCOL\x01", start + 8)
