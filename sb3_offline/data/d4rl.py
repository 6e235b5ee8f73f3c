"""D4RL-style HDF5 files: flat arrays of observations, actions, rewards, terminals and timeouts."""

import os
from typing import Any

import h5py
import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.format import FORMAT, Header
from sb3_offline.data.spaces import check_observations, check_rows

REQUIRED = ("observations", "actions", "terminals")


def is_d4rl(file: h5py.File) -> bool:
    """:return: whether an open HDF5 file has the arrays of a D4RL-style file"""
    return file.attrs.get("format") != FORMAT and all(isinstance(file.get(name), h5py.Dataset) for name in REQUIRED)


def read_d4rl(
    file: h5py.File,
    path: str | os.PathLike,
    observation_space: spaces.Space | None = None,
    action_space: spaces.Space | None = None,
) -> tuple[Header, dict[str, Any]]:
    """
    Read a D4RL-style file into memory, as the arrays of our format.

    Such a file has one observation per step. Where it has no ``next_observations``, the observation after the last step of an
    episode is unknown. A terminated episode repeats its last observation there: learners that stop at ``terminated`` never use
    it, but to those that ignore it, as learners from success examples do, the last step seems to change nothing. Any other
    episode ends one step earlier instead, as in D4RL's own ``qlearning_dataset``.

    :param file: the open file
    :param path: for error messages
    :param observation_space: default: unbounded (0 to 255 for uint8), with the shape of the data
    :param action_space: default: [-1, 1] with the shape of the data
    :return: header and arrays by name, as ``Header.fields`` names them
    """
    names = [*REQUIRED, *(n for n in ("rewards", "timeouts", "next_observations") if n in file)]
    raw = {name: file[name][()] for name in names}
    n = len(raw["actions"])
    for name, array in raw.items():
        if len(array) != n:
            problem = f"has {len(array)} rows, but actions has {n}"
            raise DatasetError(path, name, problem, "All arrays of a D4RL-style file have one row per step")
    if n == 0:
        raise DatasetError(path, "actions", "holds no step", "Check how the file was written")
    observation_space = observation_space or _observation_space(raw["observations"])
    action_space = action_space or _action_space(raw["actions"], path)

    terminated = raw["terminals"].reshape(n).astype(bool)
    timeouts = raw["timeouts"].reshape(n).astype(bool) if "timeouts" in raw else np.zeros(n, dtype=bool)
    ends = np.flatnonzero(terminated | timeouts)
    if len(ends) == 0 or ends[-1] != n - 1:
        ends = np.append(ends, n - 1)  # the rest was cut off: an episode that neither flag ends
    starts = np.append(0, ends[:-1] + 1)
    steps_lost = np.zeros(len(ends), dtype=np.int64)
    if "next_observations" not in raw:
        steps_lost[~terminated[ends]] = 1
    lengths = ends + 1 - starts - steps_lost
    starts, ends, lengths = starts[lengths > 0], (starts + lengths - 1)[lengths > 0], lengths[lengths > 0]
    # Step rows to keep, and for each observation row of the result its row in the file
    steps = _ranges(starts, lengths)
    rows = _ranges(starts, lengths + 1)
    last = np.cumsum(lengths + 1) - 1
    known = np.zeros(len(last), dtype=bool)
    if "next_observations" not in raw:
        known = ~terminated[ends]  # one step was taken off, so that the observation after it is the next row
    rows[last[~known]] -= 1
    observations = raw["observations"][rows]
    if "next_observations" in raw:
        observations[last] = raw["next_observations"][ends]

    header = Header(
        observation_space, action_space, provenance={"format": "D4RL"}, rewards="rewards" in raw, success=False, extras={}
    )
    arrays: dict[str, Any] = {"episodes/length": lengths, "episodes/seed": np.full(len(lengths), -1, dtype=np.int64)}
    arrays |= check_observations(observations, observation_space, None, path)
    truncated = np.zeros(len(steps), dtype=bool)
    truncated[np.cumsum(lengths) - 1] = ~terminated[ends]
    step_arrays = {"actions": raw["actions"][steps], "terminated": terminated[steps], "truncated": truncated}
    if "rewards" in raw:
        step_arrays["rewards"] = raw["rewards"].reshape(n)[steps]
    fields = header.fields()
    for name, array in step_arrays.items():
        arrays[name] = check_rows(array, fields[name].shape, fields[name].dtype, None, path, name)
    return header, arrays


def _ranges(starts: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """:return: the concatenation of ``arange(start, start + length)``"""
    offsets = np.cumsum(lengths) - lengths
    return np.arange(lengths.sum()) + np.repeat(starts - offsets, lengths)


def _observation_space(observations: np.ndarray) -> spaces.Box:
    if observations.dtype == np.uint8:
        return spaces.Box(0, 255, observations.shape[1:], np.uint8)
    return spaces.Box(-np.inf, np.inf, observations.shape[1:], np.float32)


def _action_space(actions: np.ndarray, path: str | os.PathLike) -> spaces.Space:
    if actions.dtype.kind != "f":
        problem = f"has dtype {actions.dtype}, and a D4RL-style file does not say which actions there are"
        raise DatasetError(path, "actions", problem, "Open it with OfflineDataset(path, action_space=...)")
    if np.abs(actions).max() > 1 + 1e-5:
        problem = f"reaches from {actions.min():.4g} to {actions.max():.4g}, and a D4RL-style file does not declare its bounds"
        raise DatasetError(path, "actions", problem, "Open it with OfflineDataset(path, action_space=...)")
    return spaces.Box(-1.0, 1.0, actions.shape[1:], np.float32)
