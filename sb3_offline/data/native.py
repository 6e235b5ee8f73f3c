"""Reading files of our own format: the structure is checked, small arrays are read, large ones stay in the file."""

from pathlib import Path
from typing import NamedTuple

import h5py

from sb3_offline.data.arrays import ArrayLike, HDF5Array, MappedArray, MappedFile
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.format import FORMAT, Header, Storage, read_header

# Observations and extras may be as large as the disk, so they are left there.
LEFT_IN_THE_FILE = ("observations", "extras/")


class Native(NamedTuple):
    """
    The contents of a file.

    :param header: spaces, attributes, and which arrays there are
    :param arrays: by name, as ``Header.fields`` names them
    :param storage: how the file stores its arrays
    """

    header: Header
    arrays: dict[str, ArrayLike]
    storage: Storage


def is_native(file: h5py.File) -> bool:
    """
    :param file: an open HDF5 file
    :return: whether it says that it is of our own format
    """
    return bool(file.attrs.get("format") == FORMAT)


def read_native(file: h5py.File, path: Path) -> Native:
    """
    Read the committed episodes of a file. A file that a killed writer left has room for more rows than these.

    :param file: an open file of our own format
    :param path: its path
    :return: its contents
    :raises DatasetError: if the file is of a newer version, or if an array is missing, too short, or of another kind
    """
    header = read_header(file, path)
    fields = header.fields()
    found = {name: file.get(name) for name in ["n_episodes", *fields]}  # looked up once: HDF5 takes most of the time
    for name, array in found.items():
        if not isinstance(array, h5py.Dataset):
            raise DatasetError(path, name, "is missing", "Write the file again with DatasetWriter")
    n_episodes, n_steps = _count(found["n_episodes"], found["episodes/length"], path)
    storage: Storage = "contiguous" if found["actions"].chunks is None else "compressed"
    # Map the very file that is open: a writer may have put a larger one at its path in the meantime.
    mapped = MappedFile(path, file.id.get_vfd_handle()) if storage == "contiguous" else None
    arrays: dict[str, ArrayLike] = {}
    for name, spec in fields.items():
        array, rows = found[name], spec.rows(n_episodes, n_steps)
        shape, dtype = array.shape, array.dtype
        if dtype != spec.dtype or shape[1:] != spec.shape:
            problem = f"holds rows of shape {shape[1:]} and dtype {dtype}, expected {spec.shape} {spec.dtype}"
            raise DatasetError(path, name, problem, "Write the file again with DatasetWriter")
        if shape[0] < rows:
            problem = f"has {shape[0]} rows, but {n_episodes} episodes of {n_steps} steps need {rows}"
            raise DatasetError(path, name, problem, "Leave out incomplete episodes, or write the file again")
        if not name.startswith(LEFT_IN_THE_FILE) or rows * spec.row_bytes == 0:
            arrays[name] = array[:rows]
        elif mapped is not None and (offset := array.id.get_offset()) is not None:
            arrays[name] = MappedArray(mapped, offset, rows, spec)
        else:
            arrays[name] = HDF5Array(path, name, rows, spec)
    return Native(header, arrays, storage)


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
    return n, int(existing.sum())
