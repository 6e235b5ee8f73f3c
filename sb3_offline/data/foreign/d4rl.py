"""D4RL: flat arrays of observations, actions, rewards, terminals and timeouts, in an HDF5 file or in a dict."""

import warnings
from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.foreign.base import Foreign, Format, Options
from sb3_offline.data.foreign.episodes import (
    cut_episodes,
    follows,
    guess_action_space,
    guess_observation_space,
    lengths_so_far,
)
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.format import Header

REQUIRED = ("observations", "actions", "terminals")
OPTIONAL = ("rewards", "timeouts", "next_observations")


def recognizes(probe: Probe) -> bool:
    """
    :param probe: a path or an object
    :return: whether it is an HDF5 file or a dict with the arrays that every D4RL dataset has
    """
    if not probe.names.issuperset(REQUIRED):
        return False
    if probe.hdf5 is not None:
        return all(isinstance(probe.hdf5[name], h5py.Dataset) for name in REQUIRED)
    return isinstance(probe.given, Mapping)


def read(probe: Probe, options: Options) -> Foreign:
    """
    Read D4RL's arrays into memory.

    There is one observation for each step. Without ``next_observations``, the observation after the last step of an episode
    is unknown. An episode that does not terminate then ends one step earlier, as in D4RL's own ``qlearning_dataset``, see
    :func:`~sb3_offline.data.foreign.episodes.cut_episodes`.

    Without ``timeouts``, the option ``max_episode_steps`` says where episodes end. Without either, an episode ends where it
    terminates and, if there are ``next_observations``, where these differ from the observation in the next row.

    :param probe: the file or the dict
    :param options: ``observation_space`` (default: unbounded, 0 to 255 for uint8, of the data's shape), ``action_space``
        (default: [-1, 1]) and ``max_episode_steps``
    :return: the data
    """
    path, raw = probe.path, _arrays(probe)
    n = len(raw["actions"])
    header = Header(
        options.observation_space or guess_observation_space(raw["observations"]),
        options.action_space or guess_action_space(raw["actions"], path),
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
    if "timeouts" not in raw and options.max_episode_steps:
        ends |= lengths_so_far(ends) % options.max_episode_steps == 0
    elif "timeouts" not in raw and following is None:
        warnings.warn(
            f"{path}: timeouts: are missing, and so are next_observations. Episodes are taken to end only where they "
            "terminate. If a time limit ended some, give it: OfflineDataset(path, max_episode_steps=...), or convert --env ID."
        )
    ends[-1] = True  # the data end here, whether or not the episode did
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
    return Foreign(header, arrays)


def _arrays(probe: Probe) -> dict[str, np.ndarray]:
    """:return: the arrays in memory, each with one row for each step"""
    given: Any = probe.given if probe.hdf5 is None else probe.hdf5
    raw = {name: np.asarray(given[name]) for name in (*REQUIRED, *OPTIONAL) if name in given}
    n = _rows(raw["actions"])
    for name, array in raw.items():
        if _rows(array) != n:
            problem = f"has {_rows(array)} rows, but actions has {n}"
            raise DatasetError(probe.path, name, problem, "All arrays of a D4RL dataset have one row for each step")
        shape = raw["observations"].shape if name == "next_observations" else (n,)
        if name not in ("observations", "actions") and array.size != np.prod(shape):
            problem = f"has shape {array.shape}, expected {shape}"
            raise DatasetError(probe.path, name, problem, "Check how the data were written")
    if n == 0:
        raise DatasetError(probe.path, "actions", "holds no step", "Check how the data were written")
    return raw


def _rows(array: np.ndarray) -> int:
    return len(array) if array.ndim else 0


FORMAT = Format(
    name="D4RL",
    description=f"an HDF5 file or a dict with {', '.join(REQUIRED)}",
    recognizes=recognizes,
    read=read,
    declares_spaces=False,
)
