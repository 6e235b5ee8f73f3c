"""A writer that commits whole episodes: a process killed at any moment leaves a file that opens and holds them all."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import lock_file, open_hdf5, replacing, temporary_path
from sb3_offline.data.format import Header, create_file, read_header
from sb3_offline.data.spaces import check_extra, check_observations, check_rows, to_array

COPY_BYTES = 1 << 24


class DatasetWriter:
    """
    Write a dataset file of format version 1, one whole episode at a time.

    How it survives a kill: the HDF5 file is created with room to spare (sparse, so that the room takes no space on disk) and
    closed; from then on no HDF5 metadata changes. An episode's rows go straight to their places in the file, are
    synced to disk, and only then one write of 8 bytes to ``n_episodes`` makes the episode exist. When the room is used up, and
    at the end, the rows are copied to a new file of the right size that replaces the old one in one step.

    :param path: the file to write
    :param observation_space: space of one observation (Box, Discrete, MultiDiscrete, MultiBinary, or a Dict of these)
    :param action_space: space of one action, in the environment's own units
    :param env_id: gymnasium id of the environment, if any
    :param env_kwargs: its keyword arguments (JSON)
    :param provenance: where the data come from: program, command, seed, versions, policy, ... (JSON). When appending, a
        provenance other than the file's is added to the list ``provenance["appended"]``
    :param mode: "x": the file must not exist; "w": replace it, once the first episode is there (or on closing without an
        error); "a": append to it (which copies it once), or create it
    :param rewards: whether episodes have rewards
    :param success: whether episodes have success labels
    :param extras: further per-step arrays: name to (shape of one row, dtype)
    :param sources: labels that episodes may name as their source
    :param capacity: room for so many (episodes, steps) at first; it grows by itself, at the price of copying the file
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
        self.path = Path(os.path.realpath(path))
        if mode not in ("x", "w", "a"):  # or a mistyped mode would replace the file
            raise DatasetError(self.path, "mode", f"is {mode!r}", "Give 'x', 'w' or 'a'")
        self.n_episodes = 0
        self.n_steps = 0
        self._file: Any = None
        self._replaces = False  # whether the file at the path still is the old one, which this one is to replace
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
        self._fields = self._header.fields()
        try:
            self._open(mode, capacity)
        except BaseException:
            self._release()  # the error's traceback keeps this object, and with it the lock
            raise

    def _open(self, mode: str, capacity: tuple[int, int]) -> None:
        if self.path.exists():
            if mode == "x":
                raise DatasetError(self.path, "file", "exists already", 'Open it with mode="a" to append or "w" to replace it')
            self._attach()
            if mode == "a":
                self._adopt()
        temporary_path(self.path).unlink(missing_ok=True)  # what a killed writer left; the lock says that it is gone
        self._capacity = (self.n_episodes + max(capacity[0], 1), self.n_steps + max(capacity[1], 1))
        if self._file is not None and mode == "w":
            self._header.attributes()  # what cannot be stored is refused here already
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
        Write one episode of T steps. When this returns, the episode is in the file, whatever happens to the process.
        Nothing is written unless all of it is valid (``DatasetError`` otherwise).

        :param observations: ``(T + 1, *shape)``, or a dict of such for a Dict space: the last observation too
        :param actions: ``(T, *shape)`` in the environment's units
        :param rewards: (T,) float; required if the file has rewards
        :param terminated: (T,) bool, true at most in the last step; default: never
        :param truncated: (T,) bool, true at most in the last step; default: in the last step, if that did not terminate
        :param success: (T,) bool, success after each step; required if the file has success labels
        :param extras: the file's further arrays, each with T rows
        :param seed: seed of the episode, -1 for none
        :param source: one of the file's source labels; required if it has any
        """
        if self._file is None:
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
        steps |= {f"extras/{name}": value for name, value in (extras or {}).items()}
        rows = check_observations(observations, self._header.observation_space, n + 1, self.path)
        rows |= self._check_steps({name: value for name, value in steps.items() if value is not None}, n)
        rows |= self._episode_rows(n, seed, source)
        if self._replaces:
            self._rewrite((self._capacity[0], max(self._capacity[1], n)), rows)
        else:
            self._commit(rows, n)
        self.n_episodes += 1
        self.n_steps += n

    def close(self) -> None:
        """Copy the file to its exact size (unless it has that already) and close it. Further calls do nothing."""
        if self._file is None:
            return
        try:
            if self._replaces or self._capacity != (self.n_episodes, self.n_steps):
                self._rewrite((self.n_episodes, self.n_steps))
        finally:
            self._release()

    def _release(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> "DatasetWriter":
        return self

    def __exit__(self, exc_type: Any, *exc_info: Any) -> None:
        if exc_type is not None and self._replaces:
            self._release()  # nothing came to replace the old file
        else:
            self.close()

    def _check_steps(self, values: dict[str, Any], n: int) -> dict[str, np.ndarray]:
        """Check the arrays with one row per step, given by their names in the file."""
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
        return rows

    def _episode_rows(self, n: int, seed: int, source: str | None) -> dict[str, np.ndarray]:
        if not (isinstance(seed, int | np.integer) and -(2**63) <= seed < 2**63):
            raise DatasetError(
                self.path, "seed", f"is {seed!r}, no integer of 64 bits", "Give the episode's seed, or -1 for none"
            )
        rows = {"episodes/length": np.array([n], np.int64), "episodes/seed": np.array([seed], np.int64)}
        sources = self._header.sources
        if (source not in sources) if sources is not None else (source is not None):
            problem = f"is {source!r}, the file's sources are {sources}"
            raise DatasetError(self.path, "source", problem, "Name one of them, or give all labels when creating the file")
        if sources is not None:
            rows["episodes/source"] = np.array([sources.index(str(source))], np.int16)
        return rows

    def _commit(self, rows: dict[str, np.ndarray], n: int) -> None:
        if self.n_episodes + 1 > self._capacity[0] or self.n_steps + n > self._capacity[1]:
            self._rewrite((2 * self._capacity[0], 2 * self._capacity[1] + n))
        for name, array in rows.items():
            first_row = self._fields[name].rows(self.n_episodes, self.n_steps)
            self._write(self._offsets[name] + first_row * self._fields[name].row_bytes, array)
        os.fsync(self._file.fileno())  # the order matters: rows on disk first, then the number that makes them exist
        self._write(self._offsets["n_episodes"], np.array(self.n_episodes + 1, dtype=np.int64))

    def _write(self, offset: int, array: np.ndarray) -> None:
        self._file.seek(offset)
        _write_all(self._file, memoryview(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data))

    def _attach(self) -> None:
        """Open the file at its path for writing, as the only writer."""
        self._release()
        self._file = open(self.path, "r+b", buffering=0)
        lock_file(self._file, self.path)

    def _read_places(self, file: h5py.File) -> None:
        self._offsets = {name: file[name].id.get_offset() or 0 for name in [*self._fields, "n_episodes"]}
        self._capacity = (len(file["episodes/length"]), len(file["actions"]))

    def _adopt(self) -> None:
        """Take over the episodes of the file, and what its header says."""
        with open_hdf5(self.path) as file:
            present = read_header(file, self.path)
            self._check_same(present, file["actions"].chunks is not None)
            self._read_places(file)
            self.n_episodes = int(file["n_episodes"][()])
            self.n_steps = int(file["episodes/length"][: self.n_episodes].sum())
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
            problem = f"has other arrays ({sorted(present.fields())}) than those to be appended ({sorted(wanted.fields())})"
            raise DatasetError(self.path, "file", problem, "Append with the same arrays, or write another file")

    def _rewrite(self, capacity: tuple[int, int], first: dict[str, np.ndarray] | None = None) -> None:
        """
        Copy the committed rows to a file of another capacity, which then replaces this one; also creates a file, empty or with
        the rows of its first episode.
        """
        with replacing(self.path) as temporary:
            create_file(temporary, self._header, *capacity, committed=1 if first else self.n_episodes)
            if first:
                with h5py.File(temporary, "r+", locking=False) as file:
                    for name, array in first.items():
                        file[name][: len(array)] = array
            if self.n_episodes:
                with open_hdf5(temporary) as file, open(temporary, "r+b", buffering=0) as target:
                    for name, spec in self._fields.items():
                        size = spec.rows(self.n_episodes, self.n_steps) * spec.row_bytes
                        _copy(self._file, self._offsets[name], target, file[name].id.get_offset(), size)
        self._replaces = False
        self._attach()
        with open_hdf5(self.path) as file:
            self._read_places(file)


def _copy(source: Any, source_offset: int, target: Any, target_offset: int, size: int) -> None:
    source.seek(source_offset)
    target.seek(target_offset)
    while size > 0:
        data = source.read(min(size, COPY_BYTES))
        _write_all(target, memoryview(data))
        size -= len(data)


def _write_all(file: Any, data: memoryview) -> None:
    while data:  # the system may write less than asked for (Linux: at most 2 GiB at once)
        data = data[file.write(data) :]
