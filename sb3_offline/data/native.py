"""Reading files of our own format: the structure is checked, small arrays are read, large ones stay in the file."""

import os
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

from sb3_offline.data.arrays import ArrayLike, HDF5Array, MappedArray, MappedFile
from sb3_offline.data.checksums import Checksums, read_checksums
from sb3_offline.data.errors import DAMAGE_ERRORS, DatasetError, damaged_file
from sb3_offline.data.format import FORMAT, Header, Storage, read_header
from sb3_offline.data.plain import check_plain, check_stored, is_text, read_attribute

# Observations and extras may be as large as the disk, so they are left there.
LEFT_IN_THE_FILE = ("observations", "extras/")


class Native(NamedTuple):
    """
    The contents of a file.

    :param header: spaces, attributes, and which arrays there are
    :param arrays: by name, as ``Header.fields`` names them
    :param storage: how the file stores its arrays
    :param checksums: the checksums of its episodes, which have not been compared with the arrays; ``None`` if it has none
    """

    header: Header
    arrays: dict[str, ArrayLike]
    storage: Storage
    checksums: Checksums | None


def is_native(file: h5py.File) -> bool:
    """
    :param file: an open HDF5 file
    :return: whether it says that it is of our own format
    """
    return is_text(read_attribute(file, "format"), FORMAT)


def read_native(file: h5py.File, path: Path) -> Native:
    """
    Read the committed episodes of a file. A file that a killed writer left has room for more rows than these.

    :param file: an open file of our own format
    :param path: its path
    :return: its contents
    :raises DatasetError: if the file is of a newer version, or if an array is missing, too short, or of another kind
    """
    try:
        return _read(file, path)
    except DatasetError:
        raise
    except DAMAGE_ERRORS as error:
        raise damaged_file(path, error) from error


def _read(file: h5py.File, path: Path) -> Native:
    header = read_header(file, path)
    fields = header.fields()
    check_plain(file, path, ["n_episodes", *fields])
    size = os.fstat(file.id.get_vfd_handle()).st_size
    found = {name: file.get(name) for name in ["n_episodes", *fields]}  # looked up once: HDF5 takes most of the time
    for name, array in found.items():
        if not isinstance(array, h5py.Dataset) or array.shape is None:
            raise DatasetError(path, name, "is missing", "Write the file again with DatasetWriter")
    for name in ("n_episodes", "episodes/length"):
        _check_integers(found[name], 0 if name == "n_episodes" else 1, path, name)
    check_stored(found["episodes/length"], len(found["episodes/length"]), 8, size, path)
    n_episodes, n_steps = _count(found["n_episodes"], found["episodes/length"], path)
    storage: Storage = "contiguous" if found["actions"].chunks is None else "compressed"
    # Map the very file that is open: a writer may have put a larger one at its path in the meantime.
    mapped = MappedFile(path, file.id.get_vfd_handle()) if storage == "contiguous" else None
    arrays: dict[str, ArrayLike] = {}
    for name, spec in fields.items():
        array, rows = found[name], spec.rows(n_episodes, n_steps)
        shape, dtype = array.shape, array.dtype
        if dtype != spec.dtype or not shape or shape[1:] != spec.shape:
            rows_of = f"rows of shape {shape[1:]}" if shape else "a single value"
            problem = f"holds {rows_of} and dtype {dtype}, expected {spec.shape} {spec.dtype}"
            raise DatasetError(path, name, problem, "Write the file again with DatasetWriter")
        if shape[0] < rows:
            problem = f"has {shape[0]} rows, but {n_episodes} episodes of {n_steps} steps need {rows}"
            raise DatasetError(path, name, problem, "Leave out incomplete episodes, or write the file again")
        check_stored(array, rows, spec.row_bytes, size, path)
        if not name.startswith(LEFT_IN_THE_FILE) or rows * spec.row_bytes == 0:
            arrays[name] = array[:rows]
        elif mapped is not None and (offset := array.id.get_offset()) is not None:
            arrays[name] = MappedArray(mapped, offset, rows, spec)
        else:
            arrays[name] = HDF5Array(path, name, rows, spec)
    return Native(header, arrays, storage, read_checksums(file, path, fields, n_episodes, found["episodes/length"], size))


def _check_integers(array: h5py.Dataset, ndim: int, path: Path, name: str) -> None:
    if array.ndim != ndim or array.dtype.kind not in "iu":
        expected = "one integer" if ndim == 0 else "one integer for each episode"
        problem = f"has shape {array.shape} and dtype {array.dtype}, expected {expected}"
        raise DatasetError(path, name, problem, "Write the file again with DatasetWriter")


def _count(n_episodes: h5py.Dataset, lengths: h5py.Dataset, path: Path) -> tuple[int, int]:
    """:return: the numbers of episodes and steps that exist"""
    n, room = int(n_episodes[()]), len(lengths)
    if not 0 <= n <= room:
        problem = f"is {n}, but episodes/length has {room} rows"
        raise DatasetError(path, "n_episodes", problem, "The file is damaged: take a copy, or write it again")
    existing = lengths[:n]
    if n and existing.min() < 1:
        problem = f"holds an episode of {existing.min()} steps"
        raise DatasetError(path, "episodes/length", problem, "Leave empty episodes out")
    if existing.sum(dtype=np.float64) > 2.0**62:
        problem = f"adds up to more steps than a file can hold, with {existing.max()} in one episode"
        raise DatasetError(path, "episodes/length", problem, "The file is damaged: take a copy, or write it again")
    return n, int(existing.sum())
