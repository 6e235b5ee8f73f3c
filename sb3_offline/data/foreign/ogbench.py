"""OGBench: flat arrays like D4RL's, but ``terminals`` mark the last row of a trajectory, whose action is a dummy."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.foreign.base import Foreign, Format, Options
from sb3_offline.data.foreign.episodes import cut_episodes, guess_action_space, guess_observation_space
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.foreign.recorded import read_npz, readable
from sb3_offline.data.format import Header
from sb3_offline.data.spaces import check_observations, check_rows

NAME = "OGBench"
REQUIRED = ("observations", "actions", "terminals")
# `valids` and `next_observations` are added by OGBench's loader, rewards and `masks` by its single-task environments.
LOADED = ("next_observations", "valids", "rewards", "masks")
# D4RL has these in every file. OGBench has rewards only together with `masks`.
OF_D4RL = ("rewards", "timeouts")


def recognizes(probe: Probe) -> bool:
    """
    :param probe: a path or an object
    :return: whether it is an ``.npz`` file, an HDF5 file or a dict with OGBench's arrays: those of D4RL, without rewards and
        ``timeouts``, or with ``masks`` or ``valids``
    """
    if not probe.names.issuperset(REQUIRED) or not ({"masks", "valids"} & probe.names or not set(OF_D4RL) & probe.names):
        return False
    if probe.hdf5 is not None:
        return all(isinstance(probe.hdf5[name], h5py.Dataset) for name in REQUIRED)
    return probe.kind == "zip" or isinstance(probe.given, Mapping)


def read(probe: Probe, options: Options) -> Foreign:
    """
    Read OGBench's arrays into memory.

    A trajectory of T + 1 rows has T transitions: the last row holds the last observation and a dummy action. No trajectory
    terminates, since ``terminals`` only mark where trajectories end; ``masks`` of 0 are terminations. What OGBench's loader
    gives is read too: with ``next_observations`` each row is a transition, with ``valids`` the rows of 0 are last rows.

    :param probe: the file or the dict
    :param options: ``observation_space`` (default: unbounded, 0 to 255 for uint8, of the data's shape) and ``action_space``
        (default: [-1, 1])
    :return: the data
    """
    path, raw = probe.path, _arrays(probe)
    regular = "next_observations" in raw
    if probe.kind != "zip" and not regular and not {"masks", "valids", "qpos"} & raw.keys():
        warnings.warn(
            f"{path}: terminals: are taken to mark the last rows of trajectories, with a dummy action, as in OGBench, because "
            "there are neither rewards nor timeouts. If they are terminations, as in D4RL, add an array of rewards."
        )
    ends = ~_flags(raw, "valids", path) if "valids" in raw and not regular else _flags(raw, "terminals", path)
    ends[-1] = True  # the data end here, whether or not the trajectory did
    header = Header(
        options.observation_space or guess_observation_space(raw["observations"]),
        options.action_space or guess_action_space(raw["actions"], path, NAME),
        provenance={"format": NAME},
        rewards="rewards" in raw,
        success=False,
    )
    continues = _flags(raw, "masks", path) if "masks" in raw else np.ones(len(ends), dtype=bool)
    steps = (
        {"actions": raw["actions"], "rewards": raw["rewards"].reshape(-1)} if header.rewards else {"actions": raw["actions"]}
    )
    extras = {name: array for name, array in raw.items() if name not in (*REQUIRED, *LOADED)}
    if (~continues & ~ends).any():
        extras["masks"] = continues
    if regular:
        steps |= {"terminated": ends & ~continues, "truncated": ends & continues}
        return Foreign(header, _cut_regular(header, path, raw, ends, steps, extras))
    return Foreign(header, _cut(header, path, raw["observations"], ends, continues, steps, extras))


def _cut_regular(
    header: Header,
    path: Path,
    raw: Mapping[str, np.ndarray],
    ends: np.ndarray,
    steps: dict[str, np.ndarray],
    extras: dict[str, np.ndarray],
) -> dict[str, Any]:
    """:return: the arrays where each row is a transition"""
    header.extras = {name: (array.shape[1:], array.dtype) for name, array in extras.items()}
    return cut_episodes(
        header,
        path,
        observations={"observations": raw["observations"]},
        next_observations={"observations": raw["next_observations"]},
        known=np.ones(len(ends), dtype=bool),
        ends=ends,
        steps={**steps, **{f"extras/{name}": array for name, array in extras.items()}},
    )


def _cut(
    header: Header,
    path: Path,
    observations: np.ndarray,
    ends: np.ndarray,
    continues: np.ndarray,
    steps: dict[str, np.ndarray],
    extras: dict[str, np.ndarray],
) -> dict[str, Any]:
    """:return: the arrays where the last row of a trajectory is no transition. Observations are stored as in our format"""
    lengths = np.diff(np.flatnonzero(ends), prepend=-1) - 1
    if (lengths == 0).any():  # a trajectory of one row
        rows = np.repeat(lengths > 0, lengths + 1)
        observations, ends, continues = observations[rows], ends[rows], continues[rows]
        steps = {name: array[rows] for name, array in steps.items()}
        extras = {name: array[rows] for name, array in extras.items()}
        lengths = lengths[lengths > 0]
    if len(lengths) == 0:
        problem = "mark every row as the last one of a trajectory, so that there is no transition"
        raise DatasetError(path, "terminals", problem, "Check how the data were written")
    arrays: dict[str, Any] = {"episodes/length": lengths, "episodes/seed": np.full(len(lengths), -1, dtype=np.int64)}
    arrays |= check_observations(observations, header.observation_space, None, path)
    kept, first = ~ends, np.append(True, ends[:-1])
    for name, array in extras.items():
        # The row that the step led to, and the row of the reset beside it, as in `recorded.join_episodes`
        arrays[f"extras/{name}"] = array[~first]
        if array[first].any():
            reset = np.zeros_like(arrays[f"extras/{name}"])
            reset[first[kept]] = array[first]
            arrays[f"extras/reset.{name}"] = reset
    prefix = "extras/"
    header.extras = {n.removeprefix(prefix): (a.shape[1:], a.dtype) for n, a in arrays.items() if n.startswith(prefix)}
    fields, final = header.fields(), np.cumsum(lengths) - 1
    for name, array in steps.items():
        arrays[name] = check_rows(array[kept], fields[name].shape, fields[name].dtype, None, path, name)
    arrays["terminated"], arrays["truncated"] = np.zeros((2, int(lengths.sum())), dtype=bool)
    arrays["terminated"][final] = ~continues[kept][final]
    arrays["truncated"][final] = continues[kept][final]
    return arrays


def _arrays(probe: Probe) -> dict[str, np.ndarray]:
    """:return: the arrays in memory, each with one row for each row of the actions"""
    path = probe.path
    if probe.kind == "zip":
        raw = read_npz(path)
    else:
        given: Any = probe.given if probe.hdf5 is None else probe.hdf5
        with readable(path):
            raw = {name: np.asarray(given[name]) for name in given if not isinstance(given[name], h5py.Group | Mapping)}
    n = len(raw["actions"]) if raw["actions"].ndim else 0
    if n == 0:
        raise DatasetError(path, "actions", "holds no step", "Check how the data were written")
    for name in list(raw):
        if raw[name].ndim and len(raw[name]) == n and raw[name].dtype.kind in "biuf":
            continue
        if name in (*REQUIRED, *LOADED):
            problem = f"has shape {raw[name].shape} and dtype {raw[name].dtype}, but actions has {n} rows"
            raise DatasetError(path, name, problem, "All arrays of an OGBench dataset have one row for each action")
        warnings.warn(f"{path}: {name}: does not have one row for each action; it is left out.")
        del raw[name]
    return raw


def _flags(raw: Mapping[str, np.ndarray], name: str, path: Path) -> np.ndarray:
    """:return: (n,) bool, a copy"""
    flags = raw[name]
    if flags.size != len(flags) or not np.isin(flags, (0, 1)).all():
        raise DatasetError(path, name, "holds other values than one 0 or 1 for each row", "Check how the data were written")
    return flags.reshape(-1).astype(bool)


FORMAT = Format(
    name=NAME,
    description=f"an .npz file, an HDF5 file or a dict with {', '.join(REQUIRED)} and neither rewards nor timeouts",
    recognizes=recognizes,
    read=read,
    declares_spaces=False,
    refines=("D4RL",),
)
