"""Arrays that stay in a file: memory-mapped where the storage is contiguous, read at each access where it is compressed."""

import mmap
import os
import weakref
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from sb3_offline.data.errors import DatasetError, damaged_file
from sb3_offline.data.files import open_hdf5
from sb3_offline.data.format import Field

# Each map holds a file descriptor, and systems allow a process about a thousand of these. A dataset may have more files.
MAX_OPEN_MAPS = 128


class MappedFile:
    """
    A file that is memory-mapped as a whole, once for all of its arrays.

    At most ``MAX_OPEN_MAPS`` files stay mapped at a time. Mapping one more closes the map that has been open longest, and the
    next access to that file maps it again.

    :param path: the file
    :param descriptor: the open file; it may be closed afterwards. The file at ``path`` may be another one by now, since a
        writer replaces a file that it has outgrown
    """

    _mapped: ClassVar["weakref.WeakValueDictionary[int, MappedFile]"] = weakref.WeakValueDictionary()

    def __init__(self, path: Path, descriptor: int):
        self.path = path
        self._identity = _identity(descriptor)
        self._map: mmap.mmap | None = None
        self._open(descriptor)

    def map(self) -> mmap.mmap:
        """
        :return: the whole file, read-only. It stays open for as long as an array refers to it
        :raises DatasetError: if the map was closed and another file is at the path now
        """
        mapped = self._map
        if mapped is not None:
            return mapped
        try:
            with open(self.path, "rb") as file:
                if _identity(file.fileno()) == self._identity:
                    return self._open(file.fileno())
        except FileNotFoundError:
            pass
        problem = "was replaced or removed after the dataset was opened"
        raise DatasetError(self.path, "file", problem, "Open the dataset again")

    def _open(self, descriptor: int) -> mmap.mmap:
        self._map = mapped = mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ)
        self._mapped[id(self)] = self
        while len(self._mapped) > MAX_OPEN_MAPS:
            oldest = next(iter(self._mapped.values()), self)
            self._mapped.pop(id(oldest), None)
            oldest._map = None
        return mapped


def _identity(descriptor: int) -> tuple[int, int, int]:
    """:return: values that differ between a file and its replacement. A writer that appends in place changes none of them"""
    status = os.fstat(descriptor)
    return status.st_dev, status.st_ino, status.st_size


class MappedArray:
    """
    An array in contiguous storage. Slices are views of the memory map, and nothing is read before it is used.

    :param file: the file that holds the array
    :param offset: position of the first row in the file, in bytes
    :param rows: number of rows that exist
    :param spec: shape and dtype of one row
    """

    def __init__(self, file: MappedFile, offset: int, rows: int, spec: Field):
        self._file, self._offset = file, offset
        self.shape, self.dtype = (rows, *spec.shape), spec.dtype

    def __len__(self) -> int:
        return self.shape[0]

    def view(self) -> np.ndarray:
        """:return: the array as a read-only view of the memory map, which keeps the map open"""
        return np.ndarray(self.shape, self.dtype, self._file.map(), self._offset)

    def __getitem__(self, rows: Any) -> np.ndarray:
        return self.view()[rows]

    def take(self, rows: np.ndarray, axis: int = 0) -> np.ndarray:
        """
        :param rows: (B,) indices of rows
        :param axis: must be 0
        :return: ``(B, *shape)``, a copy of these rows
        """
        return self.view().take(rows, axis=axis)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self.view().astype(dtype or self.dtype, copy=bool(copy))


class HDF5Array:
    """
    An array in an HDF5 file that is read at each access. It keeps no file open, so threads and processes may share it.

    :param path: the file
    :param name: name of the array in the file
    :param rows: number of rows that exist
    :param spec: shape and dtype of one row
    """

    def __init__(self, path: Path, name: str, rows: int, spec: Field):
        self.path, self.name = path, name
        self.shape, self.dtype = (rows, *spec.shape), spec.dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: Any) -> np.ndarray:
        """
        :param rows: an index, a slice, or an array of indices
        :return: these rows. Scattered indices are slow, because whole chunks are decompressed: convert the file for training
        """
        if isinstance(rows, slice):
            return self._read(slice(*rows.indices(len(self))))
        indices, inverse = np.unique(np.arange(len(self))[rows], return_inverse=True)
        return self._read(indices)[inverse.reshape(np.shape(rows))]

    def _read(self, rows: slice | np.ndarray) -> np.ndarray:
        with open_hdf5(self.path) as file:
            try:
                return file[self.name][rows]
            except (OSError, RuntimeError, KeyError) as error:  # HDF5 finds a chunk damaged when it is decompressed
                raise damaged_file(self.path, error, self.name) from error

    def take(self, rows: np.ndarray, axis: int = 0) -> np.ndarray:
        """
        :param rows: (B,) indices of rows
        :param axis: must be 0
        :return: ``(B, *shape)``, these rows
        """
        return self[rows]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self[:].astype(dtype or self.dtype, copy=False)


ArrayLike = np.ndarray | MappedArray | HDF5Array
