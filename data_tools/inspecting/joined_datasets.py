"""Several dataset files of one environment, read as one dataset, so that shards can be inspected together."""

import json
from typing import Any

import numpy as np

from sb3_offline.data.reader import DatasetLike, OfflineDataset, open_datasets
from sb3_offline.data.storage import RowStore


class JoinedDatasets:
    """
    Several datasets with the attributes of one ``OfflineDataset``: ``lengths``, ``step_starts``, ``observation_starts``,
    ``source``, ``sources``, ``actions``, ``rewards``, ``success``, ... ``arrays`` has the arrays that all files have in the
    same shape, and ``left_out`` names the others.

    :param dataset: path, glob pattern, ``OfflineDataset``, or a sequence of these
    :param trust: open pickles that may run any code
    :raises DatasetError: if the files are not of one environment
    """

    def __init__(self, dataset: DatasetLike, *, trust: bool = False):
        self.parts = open_datasets(dataset, trust=trust)
        first = self.parts[0]
        self.observation_space, self.action_space = first.observation_space, first.action_space
        self.env_id, self.env_kwargs = first.env_id, first.env_kwargs
        self.lengths = np.concatenate([part.lengths for part in self.parts])
        self.n_episodes, self.n_steps = len(self.lengths), int(self.lengths.sum())
        self.step_starts = np.cumsum(self.lengths) - self.lengths
        self.observation_starts = self.step_starts + np.arange(self.n_episodes)
        self.arrays = {
            name: RowStore([part.arrays[name] for part in self.parts]) for name in first.arrays if self._in_all(name)
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

    def _in_all(self, name: str) -> bool:
        """:return: whether all files have this array, with rows of the same shape and dtype"""
        arrays = [part.arrays.get(name) for part in self.parts]
        return len({None if array is None else (array.shape[1:], array.dtype) for array in arrays}) == 1

    def _joined_sources(self) -> np.ndarray | None:
        """:return: (E,) indices into the labels of all files; each file has indices into its own labels"""
        indices = []
        for part in self.parts:
            if part.source is None:
                return None
            indices.append(np.array([self.sources.index(label) for label in part.sources], np.int64)[part.source])
        return np.concatenate(indices)

    @property
    def provenances(self) -> list[dict[str, Any]]:
        """:return: the provenances of the files, each of them once"""
        return list({json.dumps(part.provenance, sort_keys=True): part.provenance for part in self.parts}.values())

    def locate(self, episode: int) -> tuple[OfflineDataset, int]:
        """
        :param episode: index of the episode in all files
        :return: its file, and its index in that file
        """
        ends = np.cumsum([part.n_episodes for part in self.parts])
        index = int(np.searchsorted(ends, episode, side="right"))
        return self.parts[index], episode - int(ends[index] - self.parts[index].n_episodes)

    def solved(self) -> np.ndarray | None:
        """:return: (E,) bool, true for episodes that succeeded at any step; ``None`` without labels"""
        if self.success is None:
            return None
        return np.logical_or.reduceat(self.success, self.step_starts) if self.n_episodes else np.zeros(0, bool)

    def groups(self) -> dict[str, np.ndarray]:
        """:return: masks (E,) bool: "all" for all episodes, and one for the episodes of each source"""
        members = {"all": np.ones(self.n_episodes, dtype=bool)}
        if self.source is not None:
            members |= {label: self.source == index for index, label in enumerate(self.sources)}
        return members
