"""Checksums of episodes (CRC-32), by which changed bytes are found and named by array and episode."""

import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.format import ATTRIBUTES_CRC, CHECKSUMS, COLUMNS, Field, attributes_crc, checksum_columns
from sb3_offline.data.plain import check_plain, check_stored, is_text, read_attribute

PIECE_BYTES = 1 << 24
COPY_INTACT = "To copy the intact episodes: sb3-offline check FILE --rescue NEW_FILE"


class Checksums(NamedTuple):
    """
    The checksums that a file stores.

    :param names: names of the arrays, one for each column
    :param values: (E, columns) uint32
    """

    names: list[str]
    values: np.ndarray

    def of(self, name: str) -> np.ndarray:
        """
        :param name: name of an array
        :return: (E,) uint32, the checksums of its episodes
        """
        return self.values[:, self.names.index(name)]


class RunningChecksums:
    """
    The checksums of an array whose rows come in pieces.

    :param counts: (E,) number of rows of each episode
    """

    def __init__(self, counts: np.ndarray):
        self.values = np.zeros(len(counts), np.uint32)
        self._ends = np.cumsum(counts).tolist()
        self._row, self._episode = 0, 0

    def update(self, rows: np.ndarray) -> None:
        """:param rows: the next rows of the array, as they are stored"""
        raw = _bytes(rows)
        row_bytes = len(raw) // max(len(rows), 1)
        start, last = self._row, self._row + len(rows)
        while self._row < last:
            end = min(self._ends[self._episode], last)
            piece = raw[(self._row - start) * row_bytes : (end - start) * row_bytes]
            self.values[self._episode] = zlib.crc32(piece, int(self.values[self._episode]))
            self._episode += end == self._ends[self._episode]
            self._row = end


def row_checksums(rows: Mapping[str, np.ndarray], fields: Mapping[str, Field]) -> np.ndarray:
    """
    :param rows: the arrays of one episode, as they are stored
    :param fields: the arrays of the file
    :return: (1, columns) uint32
    """
    return np.array([[zlib.crc32(_bytes(rows[name])) for name in checksum_columns(fields)]], np.uint32)


def array_checksums(array: Any, counts: np.ndarray) -> np.ndarray:
    """
    :param array: an array, in memory or in a file; it is read in pieces
    :param counts: (E,) number of rows of each episode
    :return: (E,) uint32
    """
    running = RunningChecksums(counts)
    for _, piece in pieces(array, int(counts.sum())):
        running.update(piece)
    return running.values


def pieces(array: Any, rows: int) -> Iterable[tuple[int, np.ndarray]]:
    """
    :param array: an array, in memory or in a file
    :param rows: number of rows to read
    :return: the index of the first row of each piece, and the piece
    """
    row_bytes = int(np.prod(array.shape[1:], dtype=np.int64)) * array.dtype.itemsize
    step = max(PIECE_BYTES // max(row_bytes, 1), 1)
    for first in range(0, rows, step):
        yield first, array[first : min(first + step, rows)]


def counts_of(name: str, lengths: np.ndarray) -> np.ndarray:
    """
    :param name: name of an array
    :param lengths: (E,) steps of each episode
    :return: (E,) rows of each episode in this array
    """
    if name.startswith("episodes/"):
        return np.ones_like(lengths)
    return lengths + (name.split("/")[0] == "observations")


def mismatches(arrays: Mapping[str, Any], checksums: Checksums, names: Iterable[str]) -> dict[str, list[int]]:
    """
    Compare arrays with their checksums. Where the length of an episode is damaged, it is unknown where the later ones lie, so
    these are not compared.

    :param arrays: by name
    :param checksums: of the same episodes
    :param names: names of the arrays to compare
    :return: for each damaged array, its damaged episodes
    """
    lengths = arrays["episodes/length"]
    known = np.ones(len(lengths), dtype=bool)
    if "episodes/length" in checksums.names:
        known = array_checksums(lengths, np.ones_like(lengths)) == checksums.of("episodes/length")
    n_located = len(known) if known.all() else int(np.argmin(known))
    found = {}
    for name in names:
        n = len(known) if name.startswith("episodes/") else n_located
        wrong = array_checksums(arrays[name], counts_of(name, lengths[:n])) != checksums.of(name)[:n]
        if wrong.any():
            found[name] = np.flatnonzero(wrong).tolist()
    return found


def verify(
    arrays: Mapping[str, Any], checksums: Checksums, names: Iterable[str], path: Path, numbers: np.ndarray | None = None
) -> None:
    """
    :param arrays: by name
    :param checksums: of the same episodes
    :param names: names of the arrays to compare
    :param path: file, for the error message
    :param numbers: the numbers that these episodes have in the file (default: all of its episodes)
    :raises DatasetError: if an array does not match
    """
    for name, episodes in mismatches(arrays, checksums, names).items():
        raise damage(path, name, episodes if numbers is None else sorted({*numbers[episodes].tolist()}))


def damage(path: Path, name: str, episodes: Sequence[int], remedy: str = COPY_INTACT) -> DatasetError:
    """
    :param path: the file
    :param name: the damaged array
    :param episodes: its damaged episodes
    :param remedy: the action that the user can take
    :return: the error
    """
    which = f"episode {episodes[0]}" if len(episodes) == 1 else f"{len(episodes)} episodes ({ranges(episodes)})"
    verb = "does" if len(episodes) == 1 else "do"
    return DatasetError(path, name, f"{which} {verb} not match the checksums that were written with the data", remedy)


def ranges(numbers: Sequence[int]) -> str:
    """
    :param numbers: ascending numbers
    :return: a short text, such as "0-3, 7, 9-12"
    """
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    texts = [f"{first}" if first == last else f"{first}-{last}" for first, last in parts]
    return ", ".join(texts if len(texts) <= 12 else [*texts[:10], f"... {texts[-1]}"])


def read_checksums(
    file: h5py.File, path: Path, fields: Mapping[str, Field], n_episodes: int, lengths: h5py.Dataset, size: int
) -> Checksums | None:
    """
    Read the checksums of a file, and compare those that belong to the file as a whole.

    :param file: an open file of our own format
    :param path: its path
    :param fields: its arrays
    :param n_episodes: number of episodes that exist
    :param lengths: the array ``episodes/length``, with all of its rows
    :param size: size of the file, in bytes
    :return: the checksums; ``None`` if the file was written without any
    :raises DatasetError: if the attributes or the number of episodes were changed, or if an array is missing
    """
    columns, given = read_attribute(file, COLUMNS), CHECKSUMS in file
    stored = read_attribute(file, ATTRIBUTES_CRC)
    if columns is None and stored is None and not given:
        return None
    wanted = checksum_columns(fields)
    own = "Copy the file again. If you changed it yourself, write it again with DatasetWriter"
    if not is_text(columns, json.dumps(wanted)):
        known = _names(columns)
        missing = sorted(known - {*wanted})
        if missing:
            raise DatasetError(path, missing[0], "is missing, although the file has checksums of it", own)
        raise DatasetError(path, f"attribute {COLUMNS}", "does not name the arrays of the file", own)
    attributes = {name: file.attrs[name] for name in file.attrs if name != ATTRIBUTES_CRC}
    if not isinstance(stored, np.integer) or int(stored) != attributes_crc(attributes):
        problem = "do not match the checksum that was written with them"
        raise DatasetError(path, "attributes", problem, f"{own}, or delete the attribute {ATTRIBUTES_CRC}")
    check_plain(file, path, [CHECKSUMS])
    array = file.get(CHECKSUMS)
    if not isinstance(array, h5py.Dataset) or array.shape != (len(lengths), len(wanted)) or array.dtype != np.uint32:
        raise DatasetError(path, CHECKSUMS, "is missing, or holds other rows than one for each episode", own)
    check_stored(array, n_episodes, 4 * len(wanted), size, path)
    # A kill leaves at most one episode that is on the disk and not counted
    if n_episodes < len(lengths) and lengths[n_episodes + 1 :].any():
        raise DatasetError(path, "n_episodes", f"is {n_episodes}, but the file holds more episodes", own)
    return Checksums(wanted, array[:n_episodes])


def _names(columns: Any) -> set[str]:
    try:
        return {str(name) for name in json.loads(columns)}
    except (TypeError, ValueError):
        return set()


def _bytes(rows: np.ndarray) -> memoryview:
    return np.ascontiguousarray(rows).reshape(-1).view(np.uint8).data
