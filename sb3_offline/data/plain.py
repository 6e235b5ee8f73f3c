"""Checks that an HDF5 file holds its arrays itself: no links, no other files behind them, no references."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sb3_offline.data.errors import DatasetError

REMEDY = "Open only files from people you trust; copy the arrays into one file (h5repack, or write it again)"


def read_attribute(file: h5py.Group | h5py.Dataset, name: str) -> Any:
    """
    :param file: an open HDF5 file, or an array in it
    :param name: of an attribute
    :return: its value; ``None`` if it is missing or cannot be read
    """
    try:
        return file.attrs.get(name)
    except (OSError, RuntimeError, KeyError, TypeError, ValueError):
        return None


def is_text(value: Any, text: str) -> bool:
    """
    :param value: value of an attribute, of any type
    :param text: a text
    :return: whether the value is this text
    """
    return isinstance(value, str) and value == text


def check_plain(file: h5py.File, path: Path | Any, names: Iterable[str]) -> None:
    """
    Check that arrays or groups are the file's own. An array in external storage, a virtual dataset or a link would read other
    files, or other places in this one, under the name of this array.

    :param file: an open HDF5 file
    :param path: its path, for error messages
    :param names: names of arrays or groups, such as "extras/qpos"; those that do not exist are left out
    :raises DatasetError: if one of them, or a group that it is in, is no plain part of the file
    """
    checked: set[str] = set()
    for name in names:
        parts = name.split("/")
        for depth in range(1, len(parts) + 1):
            place = "/".join(parts[:depth])
            if place in checked:
                continue
            checked.add(place)
            problem = _indirection(file, place)
            if problem == "is missing":
                break
            if problem:
                raise DatasetError(path, place, problem, REMEDY)


def check_all_plain(file: h5py.File, path: Path | Any) -> None:
    """
    Check all arrays and groups of a file like :func:`check_plain`.

    :param file: an open HDF5 file
    :param path: its path, for error messages
    :raises DatasetError: if one of them is no plain part of the file
    """
    groups = [""]
    seen: set[int] = set()
    while groups:
        prefix = groups.pop()
        group = file[prefix] if prefix else file
        address = h5py.h5o.get_info(group.id).addr
        if address in seen:  # a group that is linked twice, perhaps inside of itself
            continue
        seen.add(address)
        for name in group:
            place = f"{prefix}/{name}" if prefix else name
            problem = _indirection(file, place)
            if problem:
                raise DatasetError(path, place, problem, REMEDY)
            if isinstance(file[place], h5py.Group):
                groups.append(place)


def _indirection(file: h5py.File, place: str) -> str:
    """:return: the way in which an array or a group is not the file's own; "" if it is"""
    try:
        kind = file.id.links.get_info(place.encode()).type
    except (KeyError, RuntimeError):
        return "is missing"
    if kind != h5py.h5l.TYPE_HARD:
        return "is a link to another file" if kind == h5py.h5l.TYPE_EXTERNAL else "is a link to another place"
    node = h5py.h5o.open(file.id, place.encode())
    if not isinstance(node, h5py.h5d.DatasetID):
        return "" if isinstance(node, h5py.h5g.GroupID) else "is neither an array nor a group"
    created = node.get_create_plist()
    if created.get_layout() == h5py.h5d.VIRTUAL:
        return "is a virtual dataset, which reads other files"
    if created.get_external_count():
        return "is stored in another file"
    return ""


def check_stored(array: h5py.Dataset, rows: int, row_bytes: int, size: int, path: Path | Any) -> None:
    """
    Check that a file is large enough for the rows that an array declares, before any memory is taken for them.

    :param array: a plain array
    :param rows: number of rows that are needed
    :param row_bytes: size of one row, in bytes
    :param size: size of the file, in bytes
    :param path: path of the file, for error messages
    :raises DatasetError: if rows are declared that the file does not hold
    """
    if rows == 0 or row_bytes == 0:
        return
    if array.chunks is None:
        offset = array.id.get_offset()
        if array.id.get_create_plist().get_layout() == h5py.h5d.COMPACT:
            return
        is_held = offset is not None and offset + rows * row_bytes <= size
    else:
        per_row = np.prod([-(-n // chunk) for n, chunk in zip(array.shape[1:], array.chunks[1:], strict=True)], dtype=object)
        is_held = array.id.get_num_chunks() >= -(-rows // array.chunks[0]) * per_row
    if not is_held:
        problem = f"declares {rows} rows of {row_bytes} bytes, which the file does not hold"
        raise DatasetError(path, array.name.lstrip("/"), problem, "The file is damaged: take a copy, or write it again")
