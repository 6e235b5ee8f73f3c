"""Datasets opened for reading. Opening checks everything that can be checked without reading the images."""

import glob
import os
from collections.abc import Iterator, Mapping, Sequence, Set, ValuesView
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_offline.data.arrays import ArrayLike, MappedArray
from sb3_offline.data.checks import check_values
from sb3_offline.data.checksums import Checksums, verify
from sb3_offline.data.errors import DAMAGE_ERRORS, DatasetError, damaged_file
from sb3_offline.data.foreign.base import Options
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.foreign.registry import find_path, read_foreign, recognize, unknown_format
from sb3_offline.data.format import Header, Storage
from sb3_offline.data.native import is_native, read_native
from sb3_offline.data.pickles import check_pickle
from sb3_offline.data.plain import check_all_plain


class OfflineDataset:
    """
    A dataset file of format version 1, or data of another library: D4RL-style HDF5 files or dicts, Minari datasets
    (``minari:namespace/name-v0``, or the folder), replay buffers of Stable-Baselines3 (in memory, or pickled), rollouts of
    `imitation` (``.npz``, or a folder), folders of LeRobot, files of d3rlpy, robomimic, ManiSkill, OGBench, DMC and ALOHA, and
    lists of trajectory dicts (in memory, or pickled). The format is recognised by the contents. Opening checks the data and
    raises ``DatasetError``, which names the file, the field and the remedy.

    Arrays are flat over all steps. Episode e has its steps at ``step_starts[e] + arange(lengths[e])``, and its observations,
    one more than steps, at ``observation_starts[e] + arange(lengths[e] + 1)``.

    - ``observation_space``, ``action_space``, ``env_id``, ``env_kwargs``, ``provenance``, ``sources`` (labels)
    - ``n_episodes`` (E), ``n_steps`` (N), ``lengths``, ``step_starts``, ``observation_starts``, ``seeds`` (E,) int64,
      ``source`` (E,) int16 or ``None``: index into ``sources``
    - ``observations`` ``(N + E, *shape)`` (a dict of arrays for a Dict space) and ``extras`` (N, ...) by name: read-only
      memory maps in contiguous storage, instances of ``HDF5Array`` in compressed storage
    - ``actions`` ``(N, *shape)`` float32 in the units of the environment, ``rewards`` (N,) float32 or ``None``,
      ``terminated``, ``truncated`` (N,) bool, ``success`` (N,) bool or ``None``: in memory
    - ``checksums``: the checksums that a file of format version 1 stores, or ``None``. Opening compares them with all arrays
      that it reads: all but images and extras. ``sb3-offline check`` compares them with all arrays
    - ``storage``: "contiguous", "compressed", or "memory" (data of other libraries, or selected episodes)

    Any number of datasets may be open at a time: only some of their files are kept open, and the others are opened again when
    they are needed. A dataset pickles as its path and the other arguments.

    :param path: the file, the folder, a name such as "minari:namespace/name-v0", or an object that holds data in memory
    :param observation_space: for data that do not declare their space (default: unbounded, of the data's shape)
    :param action_space: for data that do not declare their space (default: [-1, 1])
    :param max_episode_steps: time limit of the environment, for data that do not tell time limits from terminations: rollouts
        of `imitation`, replay buffers without ``handle_timeout_termination``, D4RL-style data without ``timeouts``
    :param episodes: indices of the episodes to read, as if there were no others; they are read into memory
    :param trust: open pickles that may run any code. Without it, a pickle is opened only if it holds nothing but values of
        known libraries, such as a ``ReplayBuffer`` of Stable-Baselines3
    """

    def __init__(
        self,
        path: Any,
        *,
        observation_space: spaces.Space | None = None,
        action_space: spaces.Space | None = None,
        max_episode_steps: int | None = None,
        episodes: Sequence[int] | np.ndarray | None = None,
        trust: bool = False,
    ):
        self.storage: Storage | str = "memory"
        self.checksums: Checksums | None = None
        self._options: dict[str, Any] = {
            "observation_space": observation_space,
            "action_space": action_space,
            "max_episode_steps": max_episode_steps,
            "episodes": episodes,
            "trust": trust,
        }
        self._given = find_path(path) if isinstance(path, str | os.PathLike) else path
        with Probe(self._given) as probe:
            self.path = probe.path
            try:
                self.header, arrays = self._read(probe, Options(observation_space, action_space, max_episode_steps))
            except DAMAGE_ERRORS as error:
                if probe.is_object or isinstance(error, DatasetError):
                    raise
                raise damaged_file(self.path, error) from error
        if episodes is not None:
            indices = self._options["episodes"] = _episode_indices(episodes, len(arrays["episodes/length"]), self.path)
            arrays, self.storage = _selected(arrays, indices), "memory"
            if self.checksums is not None:
                self.checksums = Checksums(self.checksums.names, self.checksums.values[indices])
        check_values(self.header, arrays, self.path)
        if self.checksums is not None:
            names = [name for name, array in arrays.items() if _is_read_on_opening(name, array)]
            verify(arrays, self.checksums, names, self.path, self._options["episodes"])
        self.arrays: dict[str, Any] = arrays
        self.observation_space, self.action_space = self.header.observation_space, self.header.action_space
        self.env_id, self.env_kwargs, self.provenance = self.header.env_id, self.header.env_kwargs, self.header.provenance
        self.sources: list[str] = self.header.sources or []
        self.lengths: np.ndarray = arrays["episodes/length"]
        self.n_episodes, self.n_steps = len(self.lengths), int(self.lengths.sum())
        self.step_starts = np.cumsum(self.lengths) - self.lengths
        self.observation_starts = self.step_starts + np.arange(self.n_episodes)
        self.seeds, self.source = arrays["episodes/seed"], arrays.get("episodes/source")
        self.actions, self.rewards = arrays["actions"], arrays.get("rewards")
        self.terminated, self.truncated = arrays["terminated"], arrays["truncated"]
        self.success = arrays.get("success")

    def _read(self, probe: Probe, options: Options) -> tuple[Header, dict[str, Any]]:
        if probe.hdf5 is not None and is_native(probe.hdf5):
            self._declares_spaces = True
            header, native_arrays, self.storage, self.checksums = read_native(probe.hdf5, probe.path)
            return header, native_arrays
        if probe.hdf5 is not None:
            check_all_plain(probe.hdf5, probe.path)
        known = recognize(probe)
        if known is None:
            raise unknown_format(probe)
        if probe.kind == "pickle" and known.unpickles and not self._options["trust"]:
            with open(probe.path, "rb") as file:
                check_pickle(
                    file, probe.path, "file", "If you trust its origin, say so: --trust, or OfflineDataset(path, trust=True)"
                )
        self._declares_spaces = known.declares_spaces
        header, arrays = read_foreign(known, probe, options)
        # Other libraries may call an end both a termination and a truncation. Learners never look beyond a termination
        arrays["truncated"] = np.asarray(arrays["truncated"], dtype=bool) & ~np.asarray(arrays["terminated"], dtype=bool)
        return header, arrays

    @property
    def observations(self) -> Any:
        """:return: all observations, or a dict of arrays for a Dict space"""
        if isinstance(self.observation_space, spaces.Dict):
            return {key: _as_plain(self.arrays[f"observations/{key}"]) for key in self.observation_space}
        return _as_plain(self.arrays["observations"])

    @property
    def extras(self) -> dict[str, Any]:
        """:return: the further arrays, by name"""
        return {name: _as_plain(self.arrays[f"extras/{name}"]) for name in self.header.extras}

    @property
    def guessed_actions(self) -> bool:
        """:return: whether the action space is a guess, because the data declare none and none was given"""
        return not self._declares_spaces and self._options["action_space"] is None

    def select(self, episodes: Sequence[int] | np.ndarray) -> "OfflineDataset":
        """
        :param episodes: indices of episodes of this dataset, or a mask with one flag for each episode
        :return: a dataset of these episodes alone, in this order, read into memory
        :raises DatasetError: if there is no such episode
        """
        given = self._options["episodes"]
        indices = _episode_indices(episodes, self.n_episodes, self.path)
        indices = indices if given is None else given[indices]
        return OfflineDataset(self._given, **{**self._options, "episodes": indices})

    def __reduce__(self) -> tuple:
        return _reopen, (self._given, self._options)


def _is_read_on_opening(name: str, array: ArrayLike) -> bool:
    """:return: whether an array is in memory, or its floats were read from a memory map to see that they are finite"""
    if isinstance(array, MappedArray):
        return array.dtype.kind == "f" and not name.startswith("extras/")
    return isinstance(array, np.ndarray)


def _reopen(path: Any, options: dict[str, Any]) -> OfflineDataset:
    return OfflineDataset(path, **options)


def _as_plain(array: ArrayLike) -> Any:
    """:return: a memory map as a NumPy array, which keeps the map open; any other array as it is"""
    return array.view() if isinstance(array, MappedArray) else array


def _episode_indices(episodes: Sequence[int] | np.ndarray, n_episodes: int, path: Path) -> np.ndarray:
    """:return: int64 indices, of a list of indices or a mask"""
    try:
        given = np.asarray(episodes)
    except ValueError:
        given = np.empty(())
    if given.ndim != 1 or (given.size and given.dtype.kind not in "iub"):
        problem = f"is {episodes!r:.100}"
        raise DatasetError(path, "episodes", problem, "Give a list of whole numbers, or one flag for each episode")
    if given.dtype == bool and len(given) != n_episodes:
        problem = f"is a mask of {len(given)} flags, but there are {n_episodes} episodes"
        raise DatasetError(path, "episodes", problem, "Give one flag for each episode")
    indices = np.flatnonzero(given) if given.dtype == bool else given.astype(np.int64)
    if ((indices < 0) | (indices >= n_episodes)).any():
        problem = f"names episode {indices.max() if indices.min() >= 0 else indices.min()}"
        raise DatasetError(path, "episodes", problem, f"Give indices from 0 to {n_episodes - 1}")
    return indices


def _selected(arrays: Mapping[str, Any], episodes: np.ndarray) -> dict[str, Any]:
    """:return: the rows of these episodes, in this order, in memory"""
    lengths = arrays["episodes/length"]
    first_steps, first_observations = np.cumsum(lengths) - lengths, np.cumsum(lengths + 1) - (lengths + 1)
    selected = {}
    for name, array in arrays.items():
        if name.startswith("episodes/"):
            selected[name] = array[episodes]
            continue
        is_observation = name.split("/")[0] == "observations"
        starts, extra = (first_observations, 1) if is_observation else (first_steps, 0)
        # Whole episodes as slices, since scattered rows of a compressed file are slow to read
        parts = [array[starts[e] : starts[e] + lengths[e] + extra] for e in episodes.tolist()]
        selected[name] = np.concatenate(parts) if parts else np.empty((0, *array.shape[1:]), array.dtype)
    return selected


#: Whatever is accepted where a dataset is asked for: a path, a glob pattern or an open dataset; an SB3 ``ReplayBuffer``, a
#: ``MinariDataset``, a dict of D4RL's arrays or a list of trajectory dicts; or a sequence of these
DatasetLike = str | os.PathLike | OfflineDataset | ReplayBuffer | Mapping[str, Any] | Sequence[Any]


def open_datasets(dataset: DatasetLike, *, trust: bool = False) -> list[OfflineDataset]:
    """
    :param dataset: anything that :class:`OfflineDataset` opens, a glob pattern, an open dataset, or a sequence of these
    :param trust: open pickles that may run any code
    :return: the datasets; those of a pattern are sorted by name
    :raises DatasetError: if there is none, or if two differ in their spaces or in whether they have rewards
    """
    datasets = list(_open_each(dataset, trust))
    if not datasets:
        raise DatasetError("", "dataset", f"{dataset!r} names no file", "Give at least one dataset file")
    first = datasets[0]
    for other in datasets[1:]:
        for name in ("observation_space", "action_space"):
            if getattr(other, name) != getattr(first, name):
                problem = f"is {getattr(other, name)}, but {getattr(first, name)} in {first.path}"
                raise DatasetError(other.path, name, problem, "Give files of one environment, or train on them separately")
        if (other.rewards is None) != (first.rewards is None):
            with_rewards, without = (first, other) if other.rewards is None else (other, first)
            problem = f"are missing, but {with_rewards.path} has them"
            raise DatasetError(without.path, "rewards", problem, "Give files that all have rewards, or none of them")
    return datasets


def _open_each(dataset: Any, trust: bool) -> Iterator[OfflineDataset]:
    if isinstance(dataset, OfflineDataset):
        yield dataset
    elif isinstance(dataset, str | os.PathLike):
        pattern = os.path.expanduser(dataset)
        paths = sorted(glob.glob(pattern, recursive=True)) if not os.path.exists(pattern) else [pattern]
        if not paths and glob.has_magic(pattern):
            raise DatasetError(pattern, "dataset", "matches no file", "Check the pattern")
        yield from (OfflineDataset(path, trust=trust) for path in paths or [pattern])
    elif isinstance(dataset, Sequence | Set | ValuesView | Iterator) and recognize(Probe(dataset)) is None:
        for part in dataset:
            yield from _open_each(part, trust)
    else:
        yield OfflineDataset(dataset, trust=trust)
