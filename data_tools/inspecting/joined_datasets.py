"""Several files of one environment, seen as one dataset: shards are inspected together."""

import json
from typing import Any

import numpy as np

from sb3_offline.data.reader import ArrayLike, DatasetSource, OfflineDataset, open_datasets


class JoinedRows:
    """
    Arrays of several files, one after the other; nothing is read before it is indexed.

    :param parts: arrays whose rows have one shape and dtype
    """

    def __init__(self, parts: list[ArrayLike]):
        self._parts = parts
        self._ends = np.cumsum([len(part) for part in parts])
        self.shape, self.dtype = (int(self._ends[-1]), *parts[0].shape[1:]), parts[0].dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice | np.ndarray) -> np.ndarray:
        """
        :param rows: a slice without a step, or (n,) int
        :return: these rows
        """
        starts = self._ends - [len(part) for part in self._parts]
        if isinstance(rows, slice):
            first, last, _ = rows.indices(len(self))
            lows, highs = np.maximum(first - starts, 0), np.minimum(last, self._ends) - starts
            pieces = [part[low:high] for part, low, high in zip(self._parts, lows, highs, strict=True) if low < high]
            if len(pieces) == 1:
                return np.asarray(pieces[0])
            return np.concatenate([np.empty((0, *self.shape[1:]), self.dtype), *pieces])
        found = np.empty((len(rows), *self.shape[1:]), self.dtype)
        for part, start, end in zip(self._parts, starts, self._ends, strict=True):
            inside = (rows >= start) & (rows < end)
            if inside.any():
                found[inside] = part[rows[inside] - start]
        return found


class JoinedDatasets:
    """
    Reads like an ``OfflineDataset``, whose names it has: ``lengths``, ``step_starts``, ``observation_starts``, ``source``,
    ``sources``, ``actions``, ``rewards``, ``success``, ... ``arrays`` holds those that all files have in the same shape;
    ``left_out`` names the others.

    :param source: path, glob pattern, ``OfflineDataset``, or a sequence of these; raises ``DatasetError`` where their
        environments differ
    """

    def __init__(self, source: DatasetSource):
        self.parts = open_datasets(source)
        first = self.parts[0]
        self.observation_space, self.action_space = first.observation_space, first.action_space
        self.env_id, self.env_kwargs = first.env_id, first.env_kwargs
        self.lengths = np.concatenate([part.lengths for part in self.parts])
        self.n_episodes, self.n_steps = len(self.lengths), int(self.lengths.sum())
        self.step_starts = np.cumsum(self.lengths) - self.lengths
        self.observation_starts = self.step_starts + np.arange(self.n_episodes)
        self.arrays = {
            name: JoinedRows([part.arrays[name] for part in self.parts]) for name in first.arrays if self._all(name)
        }
        self.left_out = sorted({name for part in self.parts for name in part.arrays} - self.arrays.keys())
        small = {
            name: self.arrays[name][:] for name in ("actions", "rewards", "terminated", "truncated") if name in self.arrays
        }
        self.actions, self.rewards = small["actions"], small.get("rewards")
        self.terminated, self.truncated = small["terminated"], small["truncated"]
        self.success = self.arrays["success"][:] if "success" in self.arrays else None
        self.sources = list(dict.fromkeys(label for part in self.parts for label in part.sources))
        self.source = self._joined_sources()

    def _all(self, name: str) -> bool:
        arrays = [part.arrays.get(name) for part in self.parts]
        return len({None if array is None else (array.shape[1:], array.dtype) for array in arrays}) == 1

    def _joined_sources(self) -> np.ndarray | None:
        """:return: (E,) indices into the labels of all files, whose own indices differ"""
        numbers = []
        for part in self.parts:
            if part.source is None:
                return None
            numbers.append(np.array([self.sources.index(label) for label in part.sources], np.int64)[part.source])
        return np.concatenate(numbers)

    @property
    def provenances(self) -> list[dict[str, Any]]:
        """:return: those that differ"""
        return list({json.dumps(part.provenance, sort_keys=True): part.provenance for part in self.parts}.values())

    def locate(self, episode: int) -> tuple[OfflineDataset, int]:
        """
        :param episode: counted through all files
        :return: its file, and its number there
        """
        ends = np.cumsum([part.n_episodes for part in self.parts])
        index = int(np.searchsorted(ends, episode, side="right"))
        return self.parts[index], episode - int(ends[index] - self.parts[index].n_episodes)

    def solved(self) -> np.ndarray | None:
        """:return: (E,) bool, whether an episode succeeded at any step; ``None`` without labels"""
        if self.success is None:
            return None
        return np.logical_or.reduceat(self.success, self.step_starts) if self.n_episodes else np.zeros(0, bool)

    def groups(self) -> dict[str, np.ndarray]:
        """:return: label to (E,) bool: all episodes, and those of each source"""
        members = {"all": np.ones(self.n_episodes, dtype=bool)}
        if self.source is not None:
            members |= {label: self.source == index for index, label in enumerate(self.sources)}
        return members
