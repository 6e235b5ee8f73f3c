"""D4RL-style HDF5 files: flat arrays of observations, actions, rewards, terminals and timeouts."""

import os
import warnings
from typing import Any

import h5py
import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.flat import cut_episodes, follows, guess_action_space, guess_observation_space, lengths_so_far
from sb3_offline.data.format import FORMAT, Header

REQUIRED = ("observations", "actions", "terminals")


def is_d4rl(file: h5py.File) -> bool:
    """:return: whether an open HDF5 file has the arrays of a D4RL-style file"""
    return file.attrs.get("format") != FORMAT and all(isinstance(file.get(name), h5py.Dataset) for name in REQUIRED)


def read_d4rl(
    file: h5py.File,
    path: str | os.PathLike,
    observation_space: spaces.Space | None = None,
    action_space: spaces.Space | None = None,
    max_episode_steps: int | None = None,
) -> tuple[Header, dict[str, Any]]:
    """
    Read a D4RL-style file into memory, as the arrays of our format.

    Such a file has one observation per step. Where it has no ``next_observations``, the observation after the last step of an
    episode is unknown: see :func:`~sb3_offline.data.flat.cut_episodes`. An episode that does not terminate then ends one
    step earlier, as in D4RL's own ``qlearning_dataset``.

    :param file: the open file
    :param path: for error messages
    :param observation_space: default: unbounded (0 to 255 for uint8), with the shape of the data
    :param action_space: default: [-1, 1] with the shape of the data
    :param max_episode_steps: time limit of the environment, for a file without ``timeouts``. Without either, an episode ends
        where it terminates, and where ``next_observations`` say that the next row is of another one
    :return: header and arrays by name, as ``Header.fields`` names them
    """
    names = [*REQUIRED, *(n for n in ("rewards", "timeouts", "next_observations") if n in file)]
    raw = {name: file[name][()] for name in names}
    n = len(raw["actions"])
    for name, array in raw.items():
        if len(array) != n:
            problem = f"has {len(array)} rows, but actions has {n}"
            raise DatasetError(path, name, problem, "All arrays of a D4RL-style file have one row per step")
        shape = raw["observations"].shape if name == "next_observations" else (n,)
        if name not in ("observations", "actions") and array.size != np.prod(shape):
            raise DatasetError(path, name, f"has shape {array.shape}, expected {shape}", "Check how the file was written")
    if n == 0:
        raise DatasetError(path, "actions", "holds no step", "Check how the file was written")
    header = Header(
        observation_space or guess_observation_space(raw["observations"]),
        action_space or guess_action_space(raw["actions"], path),
        provenance={"format": "D4RL"},
        rewards="rewards" in raw,
        success=False,
    )
    terminated = raw["terminals"].reshape(n).astype(bool)
    ends = terminated | (raw["timeouts"].reshape(n).astype(bool) if "timeouts" in raw else False)
    observations = {"observations": raw["observations"]}
    following = {"observations": raw["next_observations"]} if "next_observations" in raw else None
    if following is not None:
        ends |= ~follows(observations, following)
    if "timeouts" not in raw and max_episode_steps:
        ends |= lengths_so_far(ends) % max_episode_steps == 0
    elif "timeouts" not in raw and following is None:
        warnings.warn(
            f"{path}: timeouts: are missing, and so are next_observations: episodes end where they terminate, nowhere else. "
            "Where a time limit ended some, give it: OfflineDataset(path, max_episode_steps=...), or convert --env ID."
        )
    ends[-1] = True  # the rest was cut off
    steps = {"actions": raw["actions"], "terminated": terminated, "truncated": ~terminated}
    if "rewards" in raw:
        steps["rewards"] = raw["rewards"].reshape(n)
    arrays = cut_episodes(
        header,
        path,
        observations=observations,
        next_observations=following,
        known=np.full(n, following is not None),
        ends=ends,
        steps=steps,
    )
    return header, arrays
