"""Rows of arrays that are spread over one or several files, in memory or in the files."""

import os
from collections.abc import Sequence
from typing import Literal

import numpy as np

from sb3_offline.data.arrays import ArrayLike
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.spaces import subspaces

READ_BYTES = 1 << 26


class RowStore:
    """
    The rows of several arrays, one array after the other. Nothing is read before it is indexed.

    :param parts: arrays with rows of the same shape and dtype, e.g. one for each file
    """

    def __init__(self, parts: Sequence[ArrayLike]):
        self.parts = list(parts)
        self.ends = np.cumsum([len(part) for part in self.parts])
        self.shape, self.dtype = (int(self.ends[-1]), *self.parts[0].shape[1:]), self.parts[0].dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice | np.ndarray) -> np.ndarray:
        """
        :param rows: a slice without a step, or (B,) indices of rows
        :return: these rows; for a slice within one part a view, if the part gives one
        """
        if not isinstance(rows, slice):
            return self.take(rows)
        first, last, _ = rows.indices(len(self))
        starts = self.ends - [len(part) for part in self.parts]
        lows, highs = np.maximum(first - starts, 0), np.minimum(last, self.ends) - starts
        pieces = [part[low:high] for part, low, high in zip(self.parts, lows, highs, strict=True) if low < high]
        if len(pieces) == 1:
            return np.asarray(pieces[0])
        return np.concatenate([np.empty((0, *self.shape[1:]), self.dtype), *pieces])

    def take(self, rows: np.ndarray) -> np.ndarray:
        """
        :param rows: (B,) indices of rows
        :return: ``(B, *shape)``, a copy of these rows
        """
        if len(self.parts) == 1:
            return self.parts[0].take(rows, axis=0)
        part_of_row = np.searchsorted(self.ends, rows, side="right")
        out = np.empty((len(rows), *self.shape[1:]), self.dtype)
        for part in np.unique(part_of_row):
            here = part_of_row == part
            first_row = self.ends[part] - len(self.parts[part])
            out[here] = self.parts[part].take(rows[here] - first_row, axis=0)
        return out


def observation_stores(
    datasets: Sequence[OfflineDataset], storage: Literal["auto", "memory", "mmap"]
) -> tuple[dict[str, RowStore], Literal["memory", "mmap"]]:
    """
    :param datasets: datasets of the same spaces
    :param storage: "memory" reads all observations once. "mmap" leaves them on disk and needs contiguous storage. "auto" is
        "mmap" if they would take more than half of the memory that is available now, else "memory"
    :return: the observations by array name (``observations`` or ``observations/key``), and the storage that was chosen
    :raises DatasetError: if "mmap" was chosen, and a file is compressed
    """
    names = list(subspaces(datasets[0].observation_space, "observations"))
    columns: dict[str, list[ArrayLike]] = {name: [dataset.arrays[name] for dataset in datasets] for name in names}
    if storage not in ("auto", "memory", "mmap"):
        raise ValueError(f"dataset_storage is {storage!r}; give 'auto', 'memory' or 'mmap'")
    if storage == "auto":
        size = sum(len(array) * _row_bytes(array) for column in columns.values() for array in column)
        storage = "mmap" if size > available_memory() / 2 else "memory"
    if storage == "mmap":
        for dataset in datasets:
            if dataset.storage == "compressed":
                problem = "is compressed and cannot be memory-mapped"
                remedy = "Convert it to contiguous storage (sb3-offline convert), or use storage='memory' if it fits"
                raise DatasetError(dataset.path, "observations", problem, remedy)
            for name in names:  # decoding videos for each batch would take far longer than learning
                if mapping_remedy := getattr(dataset.arrays[name], "mapping_remedy", ""):
                    problem = "are encoded, and too large to be decoded into memory, or memory-mapping was asked for"
                    raise DatasetError(dataset.path, name, problem, mapping_remedy)
        return {name: RowStore(column) for name, column in columns.items()}, "mmap"
    return {name: RowStore([_read_all(column)]) for name, column in columns.items()}, "memory"


def available_memory() -> int:
    """:return: number of bytes of memory that this process may still take, as far as the system says"""
    available = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 1 << 33
    try:
        with open("/proc/meminfo") as file:
            values = {line.split(":")[0]: int(line.split()[1]) * 1024 for line in file}
        available = values.get("MemAvailable", available)
        with open("/sys/fs/cgroup/memory.max") as limit, open("/sys/fs/cgroup/memory.current") as current:
            return min(available, int(limit.read()) - int(current.read()))  # the limit of a container; "max" if there is none
    except (OSError, ValueError):
        return available


def _row_bytes(array: ArrayLike) -> int:
    return int(np.prod(array.shape[1:], dtype=np.int64)) * array.dtype.itemsize


def _read_all(column: Sequence[ArrayLike]) -> np.ndarray:
    """:return: all arrays in a single one. They are read in pieces, so that a compressed array never exists twice in memory"""
    if len(column) == 1 and isinstance(column[0], np.ndarray) and column[0].base is None:
        return column[0]  # in memory already
    out = np.empty((sum(len(array) for array in column), *column[0].shape[1:]), column[0].dtype)
    start = 0
    step = max(READ_BYTES // max(_row_bytes(column[0]), 1), 1)
    for array in column:
        for first in range(0, len(array), step):
            piece = array[first : min(first + step, len(array))]
            out[start : start + len(piece)] = piece
            start += len(piece)
    return out
