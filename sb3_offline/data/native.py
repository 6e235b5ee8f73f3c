"""Reading files of our own format: the structure is checked, small arrays are read, large ones stay in the file."""

from pathlib import Path
from typing import NamedTuple

import h5py

from sb3_offline.data.arrays import ArrayLike, HDF5Array, MappedArray, MappedFile
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.format import FORMAT, Field, Header, Storage, read_header

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
    n_episodes, n_steps = _count(file, header, path)
    storage: Storage = "contiguous" if file["actions"].chunks is None else "compressed"
    # Map the very file that is open: a writer may have put a larger one at its path in the meantime.
    mapped = MappedFile(path, file.id.get_vfd_handle()) if storage == "contiguous" else None
    arrays: dict[str, ArrayLike] = {}
    for name, spec in header.fields().items():
        rows = spec.rows(n_episodes, n_steps)
        _check_array(file[name], name, spec, path)
        if len(file[name]) < rows:
            problem = f"has {len(file[name])} rows, but {n_episodes} episodes of {n_steps} steps need {rows}"
            raise DatasetError(path, name, problem, "Leave out incomplete episodes, or write the file again")
        if not name.startswith(LEFT_IN_THE_FILE) or rows * spec.row_bytes == 0:
            arrays[name] = file[name][:rows]
        elif mapped is not None and (offset := file[name].id.get_offset()) is not None:
            arrays[name] = MappedArray(mapped, offset, rows, spec)
        else:
            arrays[name] = HDF5Array(path, name, rows, spec)
    return Native(header, arrays, storage)


def _count(file: h5py.File, header: Header, path: Path) -> tuple[int, int]:
    """:return: the numbers of episodes and steps that exist"""
    for name in ["n_episodes", *header.fields()]:
        if not isinstance(file.get(name), h5py.Dataset):
            raise DatasetError(path, name, "is missing", "Write the file again with DatasetWriter")
    n_episodes, room = int(file["n_episodes"][()]), len(file["episodes/length"])
    if not 0 <= n_episodes <= room:
        problem = f"is {n_episodes}, but episodes/length has {room} rows"
        raise DatasetError(path, "n_episodes", problem, "The file is damaged: take a copy, or write it again")
    lengths = file["episodes/length"][:n_episodes]
    if n_episodes and lengths.min() < 1:
        problem = f"holds an episode of {lengths.min()} steps"
        raise DatasetError(path, "episodes/length", problem, "Leave empty episodes out")
    return n_episodes, int(lengths.sum())


def _check_array(array: h5py.Dataset, name: str, spec: Field, path: Path) -> None:
    if array.dtype != spec.dtype or array.shape[1:] != spec.shape:
        problem = f"holds rows of shape {array.shape[1:]} and dtype {array.dtype}, expected {spec.shape} {spec.dtype}"
        raise DatasetError(path, name, problem, "Write the file again with DatasetWriter")
