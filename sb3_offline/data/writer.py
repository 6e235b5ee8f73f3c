"""A writer that commits whole episodes. A process killed at any moment leaves a file that opens and holds all of them."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from gymnasium import spaces

from sb3_offline.data.checks import BOTH_ENDS
from sb3_offline.data.checksums import array_checksums, counts_of, row_checksums
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import WriteLock, open_hdf5, remove_leftovers, replacing
from sb3_offline.data.format import CHECKSUMS, Field, Header, checksum_columns, checksum_field, create_file, read_header
from sb3_offline.data.native import read_native
from sb3_offline.data.spaces import check_choices, check_extra, check_observations, check_rows, to_array

COPY_BYTES = 1 << 24


class DatasetWriter:
    """
    Write a dataset file of format version 1, one whole episode at a time.

    It survives a kill as follows. The HDF5 file is created with spare room (which takes no space on disk, since the file is
    sparse) and closed. From then on, no HDF5 metadata change. The rows of an episode are written to their places in the
    file and synced to disk. Only then, one write of 8 bytes to ``n_episodes`` makes the episode exist. When the room is used
    up, and at the end, the rows are copied to a new file of the right size, which replaces the old one in one step.

    A new file appears with its first episode, or on closing without an error. From its opening until it is closed, the writer
    holds a lock (``.NAME.lock`` beside the file), so that a file has one writer at a time. Readers need no lock.

    :param path: the file to write; it may begin with ``~``
    :param observation_space: space of one observation (Box, Discrete, MultiDiscrete, MultiBinary, or a Dict of these)
    :param action_space: space of one action, in the environment's own units
    :param env_id: gymnasium ID of the environment, if any
    :param env_kwargs: keyword arguments of the environment (JSON)
    :param provenance: origin of the data: program, command, seed, versions, policy, ... (JSON). If a file with another
        provenance is appended to, this one is added to the list ``provenance["appended"]``
    :param mode: "x" creates a file, which must not exist. "w" replaces a file when the first episode has been added, or on
        closing without an error. "a" appends to a file (which copies it once), or creates it
    :param rewards: whether episodes have rewards
    :param success: whether episodes have success labels
    :param extras: further arrays with one row for each step: name to (shape of one row, dtype)
    :param sources: labels that episodes may name as their source
    :param capacity: room for (episodes, steps) at first. It grows by itself, at the price of copying the file
    :raises DatasetError: if the file exists (mode "x"), is being written by another process, or has other spaces or arrays
        than those to be appended
    """

    def __init__(
        self,
        path: str | os.PathLike,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        *,
        env_id: str = "",
        env_kwargs: Mapping[str, Any] | None = None,
        provenance: Mapping[str, Any] | None = None,
        mode: Literal["x", "w", "a"] = "x",
        rewards: bool = True,
        success: bool = True,
        extras: Mapping[str, tuple[tuple[int, ...], Any]] | None = None,
        sources: Sequence[str] | None = None,
        capacity: tuple[int, int] = (1024, 65536),
    ):
        self.path = Path(os.path.realpath(os.path.expanduser(path)))
        if mode not in ("x", "w", "a"):  # checked here, since a mistyped mode would replace the file
            raise DatasetError(self.path, "mode", f"is {mode!r}", "Give 'x', 'w' or 'a'")
        self.n_episodes = 0
        self.n_steps = 0
        self._file: Any = None
        self._lock: WriteLock | None = None  # held until the writer is closed, also while the file is replaced
        self._adopted_checksums: np.ndarray | None = None  # of the episodes of a file that has no checksums
        self._replaces = False  # whether the file is still to be created, or is an old one that is still to be replaced
        for name, value in (("env_kwargs", env_kwargs), ("provenance", provenance), ("extras", extras)):
            if value is not None and not isinstance(value, Mapping):
                raise DatasetError(self.path, name, f"is {value!r:.100}", "Give a dict")
        if not isinstance(env_id, str):
            raise DatasetError(self.path, "env_id", f"is {env_id!r:.100}", "Give the id as a text, or none")
        if sources is not None and (isinstance(sources, str) or not all(isinstance(s, str) for s in _listed(sources))):
            raise DatasetError(self.path, "sources", f"is {sources!r:.100}", "Give a list of texts")
        self._header = Header(
            observation_space,
            action_space,
            env_id=env_id,
            env_kwargs=dict(env_kwargs or {}),
            provenance=dict(provenance or {}),
            sources=None if sources is None else list(sources),
            rewards=rewards,
            success=success,
            extras=dict(extras or {}),
        )
        try:
            self._fields = self._header.fields()
            self._stored: dict[str, Field] = {**self._fields, CHECKSUMS: checksum_field(self._fields)}
        except DatasetError as error:
            raise DatasetError(self.path, error.field, error.problem, error.remedy) from error
        try:
            self._open(mode, capacity)
        except BaseException:
            self._release()  # the traceback of the error would keep this object alive, and with it the lock
            raise

    def _open(self, mode: str, capacity: tuple[int, int]) -> None:
        try:
            self._header.attributes()  # raises early if an attribute cannot be stored
        except (TypeError, ValueError) as error:
            problem = f"cannot be stored as JSON ({error})"
            raise DatasetError(self.path, "env_kwargs, provenance", problem, "Give numbers, texts, lists and dicts") from error
        self._lock = WriteLock(self.path)
        remove_leftovers(self.path)
        exists = self.path.exists()
        if exists and mode == "x":
            raise DatasetError(self.path, "file", "exists already", 'Open it with mode="a" to append or "w" to replace it')
        if exists and mode == "a":
            self._attach()
            self._adopt()
        self._capacity = (self.n_episodes + max(capacity[0], 1), self.n_steps + max(capacity[1], 1))
        if not (exists and mode == "a"):
            self._replaces = True
        else:
            self._rewrite(self._capacity)

    def add_episode(
        self,
        observations: Any,
        actions: Any,
        *,
        rewards: Any = None,
        terminated: Any = None,
        truncated: Any = None,
        success: Any = None,
        extras: Mapping[str, Any] | None = None,
        seed: int = -1,
        source: str | None = None,
    ) -> None:
        """
        Write one episode of T steps. When this method returns, the episode is in the file, whatever happens to the process.

        :param observations: ``(T + 1, *shape)`` with the observation after the last step, or a dict of such arrays for a Dict
            space
        :param actions: ``(T, *shape)`` in the environment's units
        :param rewards: (T,) float; required if the file has rewards
        :param terminated: (T,) bool, true at most in the last step (default: false)
        :param truncated: (T,) bool, true at most in the last step, and not where ``terminated`` is true (default: true in the
            last step if it did not terminate)
        :param success: (T,) bool, success after each step; required if the file has success labels
        :param extras: the further arrays of the file, each with T rows
        :param seed: seed of the episode, -1 for none
        :param source: one of the file's source labels; required if the file has any
        :raises DatasetError: if anything is invalid; nothing is written then
        """
        if self._lock is None:
            raise DatasetError(self.path, "file", "is closed", "Open a new DatasetWriter with mode='a'")
        actions = to_array(actions, self.path, "actions")
        n = len(actions) if actions.ndim else 0
        if n == 0:
            raise DatasetError(self.path, "actions", "holds no step", "Leave empty episodes out")
        if terminated is None:
            terminated = np.zeros(n, dtype=bool)
        if truncated is None:
            terminated = check_rows(terminated, (), np.dtype(bool), n, self.path, "terminated")
            truncated = np.zeros(n, dtype=bool)
            truncated[-1] = not terminated[-1]
        steps = {"actions": actions, "rewards": rewards, "terminated": terminated, "truncated": truncated, "success": success}
        if extras is not None and not isinstance(extras, Mapping):
            raise DatasetError(self.path, "extras", f"is {extras!r:.100}", "Give a dict of arrays")
        steps |= {f"extras/{name}": value for name, value in (extras or {}).items()}
        rows = check_observations(observations, self._header.observation_space, n + 1, self.path)
        rows |= self._check_steps({name: value for name, value in steps.items() if value is not None}, n)
        rows |= self._episode_rows(n, seed, source)
        rows[CHECKSUMS] = row_checksums(rows, self._fields)
        if self._replaces:
            self._rewrite((self._capacity[0], max(self._capacity[1], n)), rows)
        else:
            self._commit(rows, n)
        self.n_episodes += 1
        self.n_steps += n

    def close(self) -> None:
        """Copy the rows to a file of their exact size, unless it has that size, and close it. Further calls do nothing."""
        if self._lock is None:
            return
        try:
            if self._replaces or self._capacity != (self.n_episodes, self.n_steps):
                self._rewrite((self.n_episodes, self.n_steps))
        finally:
            self._release()

    def _release(self) -> None:
        self._detach()
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _detach(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> "DatasetWriter":
        return self

    def __exit__(self, exc_type: Any, *exc_info: Any) -> None:
        if exc_type is not None and self._replaces:
            self._release()  # keep the old file, since no episode was added
        else:
            self.close()

    def _check_steps(self, values: dict[str, Any], n: int) -> dict[str, np.ndarray]:
        """:return: the checked arrays that have one row for each step, by their names in the file"""
        expected = {name: spec for name, spec in self._fields.items() if spec.per == "step"}
        for name in expected.keys() ^ values.keys():
            if name in expected:
                raise DatasetError(self.path, name, "is missing from the episode", "Give it, or create the file without it")
            raise DatasetError(self.path, name, "is not an array of this file", "Declare it when creating the file")
        rows = {}
        for name, spec in expected.items():
            check = check_extra if name.startswith("extras/") else check_rows
            rows[name] = check(values[name], spec.shape, spec.dtype, n, self.path, name)
        for name in ("terminated", "truncated"):
            if rows[name][:-1].any():
                remedy = "An episode ends with the step that terminates or truncates it: split it there"
                raise DatasetError(self.path, name, "is true before the last step", remedy)
        if rows["terminated"][-1] and rows["truncated"][-1]:
            raise DatasetError(self.path, "truncated", *BOTH_ENDS)
        check_choices(rows["actions"], self._header.action_space, self.path, "actions")
        return rows

    def _episode_rows(self, n: int, seed: int, source: str | None) -> dict[str, np.ndarray]:
        if not (isinstance(seed, int | np.integer) and -(2**63) <= seed < 2**63):
            raise DatasetError(
                self.path, "seed", f"is {seed!r}, not an integer of 64 bits", "Give the episode's seed, or -1 for none"
            )
        rows = {"episodes/length": np.array([n], np.int64), "episodes/seed": np.array([seed], np.int64)}
        sources = self._header.sources
        is_known = isinstance(source, str) and sources is not None and source in sources
        if not is_known and not (sources is None and source is None):
            problem = f"is {source!r}, the file's sources are {sources}"
            raise DatasetError(self.path, "source", problem, "Name one of them, or give all labels when creating the file")
        if sources is not None:
            rows["episodes/source"] = np.array([sources.index(str(source))], np.int16)
        return rows

    def _commit(self, rows: dict[str, np.ndarray], n: int) -> None:
        if self.n_episodes + 1 > self._capacity[0] or self.n_steps + n > self._capacity[1]:
            self._rewrite((2 * self._capacity[0], 2 * self._capacity[1] + n))
        for name, array in rows.items():
            spec = self._stored[name]
            self._write(self._offsets[name] + spec.rows(self.n_episodes, self.n_steps) * spec.row_bytes, array)
        os.fsync(self._file.fileno())  # the order matters: first the rows must be on disk, then the number that counts them
        self._write(self._offsets["n_episodes"], np.array(self.n_episodes + 1, dtype=np.int64))

    def _write(self, offset: int, array: np.ndarray) -> None:
        self._file.seek(offset)
        _write_all(self._file, memoryview(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data))

    def _attach(self) -> None:
        """Open the file at the path for writing. The caller holds the lock."""
        self._detach()
        self._file = open(self.path, "r+b", buffering=0)

    def _read_places(self, file: h5py.File) -> None:
        self._offsets = {name: file[name].id.get_offset() or 0 for name in [*self._stored, "n_episodes"] if name in file}
        self._capacity = (len(file["episodes/length"]), len(file["actions"]))

    def _adopt(self) -> None:
        """Take over the episodes and the header of the existing file."""
        with open_hdf5(self.path) as file:
            read_header(file, self.path)  # the error for a file of another format
            present, arrays, storage, checksums = read_native(file, self.path)  # checks that the places are in this very file
            self._check_same(present, storage == "compressed")
            self._read_places(file)
            lengths = np.asarray(arrays["episodes/length"])
            self.n_episodes, self.n_steps = len(lengths), int(lengths.sum())
            if checksums is None:
                columns = [array_checksums(arrays[name], counts_of(name, lengths)) for name in checksum_columns(self._fields)]
                self._adopted_checksums = np.stack(columns, axis=1)
        header, new_provenance = self._header, self._header.provenance
        header.env_id, header.env_kwargs = present.env_id, present.env_kwargs
        if header.sources is not None and present.sources is not None:
            header.sources = list(dict.fromkeys([*present.sources, *header.sources]))
        header.provenance = present.provenance
        if new_provenance not in ({}, present.provenance):
            header.provenance = {**present.provenance, "appended": [*present.provenance.get("appended", []), new_provenance]}

    def _check_same(self, present: Header, compressed: bool) -> None:
        wanted = self._header
        if compressed:
            remedy = "Convert it to contiguous storage first (sb3-offline convert)"
            raise DatasetError(self.path, "file", "is compressed and cannot be appended to", remedy)
        if (present.observation_space, present.action_space) != (wanted.observation_space, wanted.action_space):
            problem = f"has the spaces {present.observation_space} and {present.action_space}"
            raise DatasetError(self.path, "file", problem, "Append with the same spaces, or write another file")
        if present.fields() != wanted.fields():
            problem = f"has the arrays {sorted(present.fields())}, but the arrays to append are {sorted(wanted.fields())}"
            raise DatasetError(self.path, "file", problem, "Append with the same arrays, or write another file")

    def _rewrite(self, capacity: tuple[int, int], first: dict[str, np.ndarray] | None = None) -> None:
        """
        Copy the committed rows to a file of another capacity, which then replaces this one. Without committed rows, create a
        file that is empty or has the rows of its first episode.
        """
        with replacing(self.path, self._lock) as temporary:
            create_file(temporary, self._header, *capacity, committed=1 if first else self.n_episodes)
            if first:
                with h5py.File(temporary, "r+", locking=False) as file:
                    for name, array in first.items():
                        file[name][: len(array)] = array
            if self.n_episodes:
                with open_hdf5(temporary) as file, open(temporary, "r+b", buffering=0) as target:
                    for name, spec in self._stored.items():
                        place, size = file[name].id.get_offset(), spec.rows(self.n_episodes, self.n_steps) * spec.row_bytes
                        if name in self._offsets:
                            _copy(self._file, self._offsets[name], target, place, size)
                        else:
                            target.seek(place)
                            _write_all(target, memoryview(self._adopted_checksums.view(np.uint8).reshape(-1)))  # type: ignore
        self._replaces = False
        self._attach()
        with open_hdf5(self.path) as file:
            self._read_places(file)


def _listed(values: Any) -> list[Any]:
    """:return: the values; of something that is no list, a list without texts"""
    return list(values) if isinstance(values, Sequence | np.ndarray) and np.ndim(values) == 1 else [None]


def _copy(origin: Any, origin_offset: int, target: Any, target_offset: int, size: int) -> None:
    origin.seek(origin_offset)
    target.seek(target_offset)
    while size > 0:
        data = origin.read(min(size, COPY_BYTES))
        _write_all(target, memoryview(data))
        size -= len(data)


def _write_all(file: Any, data: memoryview) -> None:
    while data:  # the system may write less than requested (Linux: at most 2 GiB at once)
        data = data[file.write(data) :]
