"""Datasets opened for reading, with everything checked that can be checked without touching the frames."""

import glob
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np
from gymnasium import spaces

from sb3_offline.data.d4rl import is_d4rl, read_d4rl
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import open_hdf5
from sb3_offline.data.foreign import read_foreign
from sb3_offline.data.format import Field, Header, Storage, read_header
from sb3_offline.data.minari import PREFIX, dataset_folder
from sb3_offline.data.spaces import subspaces

CHECK_BYTES = 1 << 24


class HDF5Array:
    """
    An array inside of an HDF5 file, read at each access. It keeps no file open, so threads and processes may share it.

    :param path: the file
    :param name: name of the array in it
    :param rows: so many rows exist
    :param spec: what they hold
    """

    def __init__(self, path: Path, name: str, rows: int, spec: Field):
        self.path, self.name = path, name
        self.shape, self.dtype = (rows, *spec.shape), spec.dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: Any) -> np.ndarray:
        """
        :param rows: one index, a slice, or an array of indices
        :return: these rows. Scattered indices are slow (whole chunks are decompressed): convert the file for training
        """
        with open_hdf5(self.path) as file:
            array = file[self.name]
            if isinstance(rows, slice):
                return array[slice(*rows.indices(len(self)))]
            indices, inverse = np.unique(np.arange(len(self))[rows], return_inverse=True)
            return array[indices][inverse.reshape(np.shape(rows))]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self[:].astype(dtype or self.dtype, copy=False)


ArrayLike = np.ndarray | HDF5Array


class OfflineDataset:
    """
    A dataset file of format version 1, or data of another library: a D4RL-style HDF5 file, a Minari dataset
    (``minari:namespace/name-v0``, or its folder), a pickled replay buffer of SB3 (``.pkl``; open none that you do not trust),
    or rollouts of `imitation` (``.npz``, or a folder). Opening checks it and raises ``DatasetError`` with the file, the field
    and the remedy.

    Arrays are flat over all steps; episode e has its steps at ``step_starts[e] + arange(lengths[e])`` and its
    observations, one more, at ``observation_starts[e] + arange(lengths[e] + 1)``.

    - ``observation_space``, ``action_space``, ``env_id``, ``env_kwargs``, ``provenance``, ``sources`` (labels)
    - ``n_episodes`` (E), ``n_steps`` (N), ``lengths``, ``step_starts``, ``observation_starts``, ``seeds`` (E,) int64,
      ``source`` (E,) int16 or ``None``: index into ``sources``
    - ``observations`` ``(N + E, *shape)``, a dict of such for a Dict space: a read-only memory map in contiguous storage,
      an ``HDF5Array`` in compressed storage. ``extras``: likewise, (N, ...) by name
    - ``actions`` ``(N, *shape)`` float32 in environment units, ``rewards`` (N,) float32 or ``None``, ``terminated``,
      ``truncated`` (N,) bool, ``success`` (N,) bool or ``None``
    - ``storage``: "contiguous", "compressed", or "memory" (other libraries' data, or chosen episodes)

    It pickles as its path and what was chosen.

    :param path: the file, folder, or ``minari:`` id
    :param observation_space: space of D4RL-style files and of rollouts, which declare none (default: unbounded, from the data)
    :param action_space: likewise (default: [-1, 1])
    :param max_episode_steps: time limit of the environment, for rollouts of `imitation` and for replay buffers without
        ``handle_timeout_termination``, which call every end of an episode terminal, and for D4RL-style files without
        ``timeouts``
    :param episodes: numbers of the episodes to hold, as if the file had no others; they are read into memory
    """

    def __init__(
        self,
        path: str | os.PathLike,
        *,
        observation_space: spaces.Space | None = None,
        action_space: spaces.Space | None = None,
        max_episode_steps: int | None = None,
        episodes: Sequence[int] | np.ndarray | None = None,
    ):
        self.path = dataset_folder(path) if os.fspath(path).startswith(PREFIX) else Path(path).absolute()
        self.storage: Storage | str = "memory"
        self._options: dict[str, Any] = {
            "observation_space": observation_space,
            "action_space": action_space,
            "max_episode_steps": max_episode_steps,
            "episodes": episodes,
        }
        foreign = read_foreign(self.path, observation_space, action_space, max_episode_steps)
        if foreign is not None:
            header, arrays, self._declares_spaces = foreign
            n_episodes = len(arrays["episodes/length"])
        else:
            header, arrays, n_episodes = self._read_hdf5(observation_space, action_space, max_episode_steps)
        if episodes is not None:
            numbers = self._options["episodes"] = _episode_numbers(episodes, n_episodes, self.path)
            arrays = _chosen_rows(arrays, numbers)
            n_episodes, self.storage = len(numbers), "memory"
        self.header = header
        self.observation_space, self.action_space = header.observation_space, header.action_space
        self.env_id, self.env_kwargs, self.provenance = header.env_id, header.env_kwargs, header.provenance
        self.sources: list[str] = header.sources or []
        self.n_episodes = n_episodes
        self.lengths: np.ndarray = np.asarray(arrays["episodes/length"])
        self.n_steps = int(self.lengths.sum())
        self.step_starts = np.cumsum(self.lengths) - self.lengths
        self.observation_starts = self.step_starts + np.arange(n_episodes)
        self.seeds, self.source = arrays["episodes/seed"], arrays.get("episodes/source")
        self.observations: ArrayLike | dict[str, ArrayLike] = arrays.get("observations", {})
        if isinstance(self.observation_space, spaces.Dict):
            self.observations = {key: arrays[f"observations/{key}"] for key in self.observation_space}
        self.actions, self.rewards = arrays["actions"], arrays.get("rewards")
        self.terminated, self.truncated = arrays["terminated"], arrays["truncated"]
        self.success = arrays.get("success")
        self.extras = {name: arrays[f"extras/{name}"] for name in header.extras}
        self.arrays = arrays
        self._check(arrays)

    @property
    def guessed_actions(self) -> bool:
        """:return: whether the action space is a guess, since the source declares none and none was given"""
        return not self._declares_spaces and self._options["action_space"] is None

    def select(self, episodes: Sequence[int] | np.ndarray) -> "OfflineDataset":
        """
        :param episodes: numbers of episodes of this dataset, or a mask of them
        :return: the same file with these alone, in this order, read into memory
        """
        given = self._options["episodes"]
        numbers = _episode_numbers(episodes, self.n_episodes, self.path)
        numbers = numbers if given is None else given[numbers]
        return OfflineDataset(self.path, **{**self._options, "episodes": numbers})

    def _read_hdf5(
        self, observation_space: spaces.Space | None, action_space: spaces.Space | None, max_episode_steps: int | None
    ) -> tuple[Header, dict[str, Any], int]:
        with open_hdf5(self.path) as file:
            self._declares_spaces = not is_d4rl(file)
            if not self._declares_spaces:
                header, arrays = read_d4rl(file, self.path, observation_space, action_space, max_episode_steps)
                return header, arrays, len(arrays["episodes/length"])
            header = read_header(file, self.path)
            n_episodes, arrays = self._read_arrays(file, header)
            self.storage = "contiguous" if file["actions"].chunks is None else "compressed"
            return header, arrays, n_episodes

    def _read_arrays(self, file: h5py.File, header: Header) -> tuple[int, dict[str, Any]]:
        """Map or read the committed rows of every array. A file that a killed writer left has room for more than these."""
        fields = header.fields()
        for name in ["n_episodes", *fields]:
            if not isinstance(file.get(name), h5py.Dataset):
                raise DatasetError(self.path, name, "is missing", "Write the file again with DatasetWriter")
        n_episodes, room = int(file["n_episodes"][()]), len(file["episodes/length"])
        if not 0 <= n_episodes <= room:
            problem = f"is {n_episodes}, but episodes/length has {room} rows"
            raise DatasetError(self.path, "n_episodes", problem, "The file is damaged: take a copy, or write it again")
        lengths = file["episodes/length"][:n_episodes]
        if n_episodes and lengths.min() < 1:
            problem = f"holds an episode of {lengths.min()} steps"
            raise DatasetError(self.path, "episodes/length", problem, "Leave empty episodes out")
        n_steps = int(lengths.sum())
        arrays = {}
        # Map the very file that is open: a writer may put a larger one in its place meanwhile
        with os.fdopen(os.dup(file.id.get_vfd_handle()), "rb") as raw:
            for name, spec in fields.items():
                array, rows = file[name], spec.rows(n_episodes, n_steps)
                if array.dtype != spec.dtype or array.shape[1:] != spec.shape:
                    problem = (
                        f"holds rows of shape {array.shape[1:]} and dtype {array.dtype}, expected {spec.shape} {spec.dtype}"
                    )
                    raise DatasetError(self.path, name, problem, "Write the file again with DatasetWriter")
                if len(array) < rows:
                    problem = f"has {len(array)} rows, but {n_episodes} episodes of {n_steps} steps need {rows}"
                    raise DatasetError(self.path, name, problem, "Leave out incomplete episodes, or write the file again")
                arrays[name] = self._read_array(array, raw, name, spec, rows)
        return n_episodes, arrays

    def _read_array(self, array: h5py.Dataset, raw: BinaryIO, name: str, spec: Field, rows: int) -> ArrayLike:
        offset = array.id.get_offset()
        if offset is not None and rows * spec.row_bytes > 0:
            mapped = np.memmap(raw, spec.dtype, "r", offset, (rows, *spec.shape))
            return mapped.view(np.ndarray)  # a plain array over the map: np.memmap itself makes every indexing slower
        if name.startswith(("observations", "extras/")) and rows:
            return HDF5Array(self.path, name, rows, spec)
        return array[:rows]

    def _check(self, arrays: dict[str, Any]) -> None:
        """Check all values that can be wrong; images of integers cannot, and are large."""
        for name in ["actions", "rewards", *subspaces(self.observation_space, "observations")]:
            if name in arrays and arrays[name].dtype.kind == "f":
                self._check_finite(name, arrays[name])
        inside = np.ones(self.n_steps, dtype=bool)
        inside[self.step_starts + self.lengths - 1] = False
        for name in ("terminated", "truncated"):
            if arrays[name][inside].any():
                row = int(np.argmax(arrays[name] & inside))
                remedy = "Split the episode there: it ends with the step that terminates or truncates it"
                raise DatasetError(self.path, name, f"is true before the last step of an episode (row {row})", remedy)
        if self.source is not None and self.n_episodes:
            if self.source.min() < 0 or self.source.max() >= len(self.sources):
                problem = f"has indices up to {self.source.max()}, but there are {len(self.sources)} labels"
                raise DatasetError(self.path, "episodes/source", problem, "Write the file again with all labels")

    def _check_finite(self, name: str, array: ArrayLike) -> None:
        rows = max(CHECK_BYTES // max(array.dtype.itemsize * int(np.prod(array.shape[1:])), 1), 1)
        for first in range(0, len(array), rows):  # by pieces: an array in compressed storage is read for this
            finite = np.isfinite(array[first : first + rows])
            if not finite.all():
                row = first + int(np.argmin(finite.reshape(len(finite), -1).all(axis=1)))
                remedy = "Leave that episode out when writing the file"
                raise DatasetError(self.path, name, f"holds NaN or infinity, first in row {row}", remedy)

    def __reduce__(self) -> tuple:
        return _reopen, (self.path, self._options)


def _reopen(path: Path, options: dict[str, Any]) -> OfflineDataset:
    return OfflineDataset(path, **options)


def _episode_numbers(episodes: Sequence[int] | np.ndarray, n_episodes: int, path: Path) -> np.ndarray:
    """:return: int64, the numbers that a list of numbers, or a mask, stands for"""
    given = np.asarray(episodes)
    if given.dtype == bool and len(given) != n_episodes:
        raise DatasetError(
            path, "episodes", f"is a mask of {len(given)}, but there are {n_episodes}", "Give one flag for each"
        )
    numbers = np.flatnonzero(given) if given.dtype == bool else given.astype(np.int64)
    if ((numbers < 0) | (numbers >= n_episodes)).any():
        problem = f"names episode {numbers.max() if numbers.min() >= 0 else numbers.min()}"
        raise DatasetError(path, "episodes", problem, f"Give numbers from 0 to {n_episodes - 1}")
    return numbers


def _chosen_rows(arrays: dict[str, Any], episodes: np.ndarray) -> dict[str, Any]:
    """:return: the arrays of some episodes, in this order, in memory"""
    lengths = np.asarray(arrays["episodes/length"])
    first_steps, first_observations = np.cumsum(lengths) - lengths, np.cumsum(lengths + 1) - (lengths + 1)
    chosen = {}
    for name, array in arrays.items():
        if name.startswith("episodes/"):
            chosen[name] = np.asarray(array)[episodes]
            continue
        is_observation = name.split("/")[0] == "observations"
        starts, extra = (first_observations, 1) if is_observation else (first_steps, 0)
        # Whole episodes as slices: scattered rows of a compressed file are slow to read
        parts = [array[starts[e] : starts[e] + lengths[e] + extra] for e in episodes.tolist()]
        chosen[name] = np.concatenate(parts) if parts else np.empty((0, *array.shape[1:]), array.dtype)
    return chosen


DatasetSource = str | os.PathLike | OfflineDataset | Sequence[str | os.PathLike | OfflineDataset]


def open_datasets(source: DatasetSource) -> list[OfflineDataset]:
    """
    :param source: a path, a glob pattern, an open dataset, or a sequence of these
    :return: the datasets, those of a pattern sorted by name; raises ``DatasetError`` where there is none, or where two do not
        have the same spaces and the same optional arrays
    """
    datasets = list(_open_each(source))
    if not datasets:
        raise DatasetError("", "dataset", f"{source!r} names no file", "Give at least one dataset file")
    first = datasets[0]
    for other in datasets[1:]:
        for name in ("observation_space", "action_space"):
            if getattr(other, name) != getattr(first, name):
                problem = f"is {getattr(other, name)}, but {getattr(first, name)} in {first.path}"
                raise DatasetError(other.path, name, problem, "Give files of one environment, or train on them apart")
        if (other.rewards is None) != (first.rewards is None):
            with_rewards, without = (first, other) if other.rewards is None else (other, first)
            problem = f"are missing, but {with_rewards.path} has them"
            raise DatasetError(without.path, "rewards", problem, "Give files that all have rewards, or none of them")
    return datasets


def _open_each(source: DatasetSource) -> Iterator[OfflineDataset]:
    if isinstance(source, OfflineDataset):
        yield source
    elif isinstance(source, str | os.PathLike):
        pattern = os.path.expanduser(source)
        paths = sorted(glob.glob(pattern, recursive=True)) if not os.path.exists(pattern) else [pattern]
        if not paths and glob.has_magic(pattern):
            raise DatasetError(pattern, "dataset", "matches no file", "Check the pattern")
        yield from (OfflineDataset(path) for path in paths or [pattern])
    else:
        for part in source:
            yield from _open_each(part)
