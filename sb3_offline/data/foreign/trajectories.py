"""Lists of trajectories, each a dict of arrays: in memory, or pickled as Decision Transformer's files are."""

import importlib
import os
import pickle
import pickletools
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.foreign.base import Foreign, Format, Options
from sb3_offline.data.foreign.d4rl import read as read_d4rl
from sb3_offline.data.foreign.d4rl import recognizes as recognizes_d4rl
from sb3_offline.data.foreign.episodes import (
    cut_episodes,
    follows,
    guess_action_space,
    guess_observation_space,
    lengths_so_far,
)
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.format import Header
from sb3_offline.data.spaces import to_array

REQUIRED = ("observations", "actions")
PER_STEP = ("rewards", "terminals", "timeouts", "dones", "success")
#: Other names of the same arrays
ALIASES = {"terminals": "terminated", "timeouts": "truncated"}
#: What a pickle of a list, a dict, a tuple, or an array of objects begins with
CONTAINERS = ("list", "dict", "numpy._core.multiarray._reconstruct", "numpy.core.multiarray._reconstruct")
# Reading the opcodes of a pickle stops here. The keys of the first trajectory come within a few hundred, if its values are
# arrays.
MAX_OPCODES = 20_000
#: Functions and classes that a pickle of arrays may name. None of them runs other code.
SAFE_NAMES = {
    "numpy": {"dtype", "ndarray"},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "numpy._core.numeric": {"_frombuffer"},
    "collections": {"OrderedDict", "defaultdict"},
    "builtins": {"list", "dict", "bytearray", "complex"},
    "_codecs": {"encode"},
}
# In pickles of Python 2
OLD_MODULES = {"__builtin__": "builtins"}


def recognizes(probe: Probe) -> bool:
    """
    :param probe: a path or an object
    :return: whether it is a list of dicts with observations and actions, or a pickle of such a list or of such a dict
    """
    if probe.is_object:
        given = probe.given
        return isinstance(given, list | tuple) and len(given) > 0 and all(_is_trajectory(part) for part in given)
    return probe.pickled in CONTAINERS and _first_texts(probe)


def _is_trajectory(value: Any) -> bool:
    return isinstance(value, Mapping) and value.keys() >= set(REQUIRED)


def _first_texts(probe: Probe) -> bool:
    """:return: whether the required keys are among the first texts of the pickle"""
    missing = set(REQUIRED)
    with open(probe.path, "rb") as file:
        try:
            for count, (_, argument, _) in enumerate(pickletools.genops(file)):
                missing -= {argument} if isinstance(argument, str) else set()
                if not missing or count > MAX_OPCODES:
                    break
        except (ValueError, TypeError):  # a damaged pickle
            pass
    return not missing


def read(probe: Probe, options: Options) -> Foreign:
    """
    Read a list of trajectories into memory.

    A trajectory is a dict with ``observations`` (an array, or a dict of arrays) and ``actions``, and optionally with
    ``rewards``, ``next_observations``, ``terminals``, ``timeouts``, ``dones`` and ``success``. It ends one episode, and a true
    ``terminals`` or ``timeouts`` ends another one before. ``dones``, which do not tell terminations from time limits, count as
    terminations where there are no ``terminals``, except in episodes of ``max_episode_steps`` steps. ``success`` may be one
    flag for the trajectory, which labels its last step.

    If a trajectory has one more observation than actions, it holds its last observation. Otherwise ``next_observations`` do.
    Without either, see :func:`~sb3_offline.data.foreign.episodes.cut_episodes`.

    Unpickling a file runs no code: a pickle that contains anything but arrays, numbers and texts is refused. A pickled dict is
    one trajectory, or D4RL's arrays.

    :param probe: the list or the file
    :param options: ``observation_space`` (default: unbounded, 0 to 255 for uint8, of the data's shape), ``action_space``
        (default: [-1, 1]) and ``max_episode_steps``
    :return: the data
    """
    given = probe.given if probe.is_object else _unpickle(probe)
    if isinstance(given, np.ndarray):
        given = given.tolist()
    if isinstance(given, Mapping):
        unpickled = Probe(given)
        unpickled.path = probe.path
        if recognizes_d4rl(unpickled):
            return read_d4rl(unpickled, options)
        given = [given]
    if not isinstance(given, list | tuple) or not given or not all(_is_trajectory(part) for part in given):
        problem = f"does not hold a list of dicts that all have {' and '.join(REQUIRED)}"
        raise DatasetError(probe.path, "trajectories", problem, "Check how the trajectories were written")
    return join_trajectories(given, probe.path, options, "trajectories")


def join_trajectories(
    trajectories: Sequence[Mapping[str, Any]], path: str | os.PathLike, options: Options, format_name: str
) -> Foreign:
    """
    :param trajectories: dicts of arrays, see :func:`read`
    :param path: file for error messages
    :param options: see :func:`read`
    :param format_name: name of the format, for the provenance and for messages
    :return: the data
    :raises DatasetError: if arrays are missing, or if they differ in shape
    """
    parts = [_arrays(trajectory, path, f"trajectory {index}") for index, trajectory in enumerate(trajectories)]
    parts = [part for part in parts if len(part["actions"])]
    if not parts:
        raise DatasetError(path, "actions", "holds no step", "Check how the trajectories were written")
    for name in sorted({name for part in parts for name in part}):
        having = [index for index, part in enumerate(parts) if name in part]
        if len(having) < len(parts):
            without = next(index for index in range(len(parts)) if index not in having)
            problem = f"is missing in trajectory {without}, but trajectory {having[0]} has it"
            raise DatasetError(path, name, problem, "Give the same keys in all trajectories")
    columns = {name: _concatenated([part[name] for part in parts], path, name) for name in parts[0]}
    actions, known = columns.pop("actions"), columns.pop("known")
    n = len(actions)
    following = {name.removeprefix("next_"): columns[name] for name in columns if name.startswith("next_observations")}
    observations = {name: array for name, array in columns.items() if name.split("/")[0] == "observations"}
    declared = options.observation_space or _guess_space(observations)
    action_space = options.action_space or guess_action_space(actions, path, format_name)
    if action_space.shape == () and actions.shape == (n, 1):
        actions = actions[:, 0]
    _check_keys(declared, observations, path)
    last = np.zeros(n, dtype=bool)
    last[np.cumsum([len(part["actions"]) for part in parts]) - 1] = True
    flags: dict[str, np.ndarray] = {name: columns[name] for name in ("terminals", "timeouts", "dones") if name in columns}
    ends = last.copy()
    for name in flags:
        ends |= flags[name]
    ends |= known & ~_follows_or_unknown(observations, following, known)
    steps = {"actions": actions, "terminated": _terminated(flags, ends, options, path)}
    steps["truncated"] = ~steps["terminated"]
    steps |= {name: columns[name] for name in ("rewards", "success") if name in columns}
    header = Header(
        declared,
        action_space,
        provenance={"format": format_name},
        rewards="rewards" in steps,
        success="success" in steps,
    )
    arrays = cut_episodes(
        header, path, observations=observations, next_observations=following, known=known, ends=ends, steps=steps
    )
    return Foreign(header, arrays)


def _terminated(flags: Mapping[str, np.ndarray], ends: np.ndarray, options: Options, path: str | os.PathLike) -> np.ndarray:
    """:return: (n,) bool, true where an episode terminated"""
    if "terminals" in flags:
        return flags["terminals"]
    if "dones" in flags:
        done = flags["dones"] & ~flags.get("timeouts", np.zeros_like(ends))
        if options.max_episode_steps:
            done &= lengths_so_far(ends) != options.max_episode_steps
        elif "timeouts" not in flags and done.any():
            warnings.warn(
                f"{path}: dones: do not tell terminations from time limits. All of them are taken for terminations. If a time "
                "limit ended some episodes, give it: OfflineDataset(path, max_episode_steps=...), or convert --env ID."
            )
        return done
    warnings.warn(
        f"{path}: terminals: are missing, and so are dones. Every trajectory is taken to end by a time limit, not by a "
        "termination."
    )
    return np.zeros_like(ends)


def _arrays(trajectory: Mapping[str, Any], path: str | os.PathLike, place: str) -> dict[str, np.ndarray]:
    """:return: the arrays of one trajectory, each with one row for each step"""
    actions = to_array(trajectory["actions"], path, f"{place}: actions")
    n = len(actions) if actions.ndim else 0
    part: dict[str, Any] = {"actions": actions, "known": np.zeros(n, dtype=bool)}
    for name in ("observations", "next_observations"):
        value = trajectory.get(name)
        if value is None:
            continue
        for key, rows in value.items() if isinstance(value, Mapping) else [("", value)]:
            array = to_array(rows, path, f"{place}: {name}")
            part[f"{name}/{key}" if isinstance(value, Mapping) else name] = array
    for name in [name for name in part if name.split("/")[0] == "observations"]:
        if len(part[name]) == n + 1:
            part[f"next_{name}"], part[name] = part[name][1:], part[name][:-1]
    given = [name for name in part if name.startswith("next_observations")]
    if given:
        part["known"][:] = True
    else:  # the last observation is unknown; these rows are never used
        part |= {f"next_{name}": part[name] for name in part if name.split("/")[0] == "observations"}
    for name in PER_STEP:
        value = trajectory.get(name, trajectory.get(ALIASES.get(name, name)))
        if value is None:
            continue
        array = to_array(value, path, f"{place}: {name}")
        if array.size == 1 and n != 1 and name != "rewards":  # one flag for the whole trajectory
            array = np.append(np.zeros(max(n - 1, 0), dtype=bool), array.reshape(1).astype(bool))
        if array.size != n:
            problem = f"has shape {array.shape}, but there are {n} actions"
            raise DatasetError(path, f"{place}: {name}", problem, "Give one value for each step")
        array = array.reshape(n)
        if name != "rewards":
            if not np.isin(array, (0, 1)).all():
                problem = "holds values other than 0 and 1"
                raise DatasetError(path, f"{place}: {name}", problem, "Give flags of true and false")
            array = array.astype(bool)
        part[name] = array
    for name, array in part.items():
        if len(array) != n:
            problem = f"has {len(array)} rows, but there are {n} actions"
            remedy = "Give one row for each action, or one more observation than actions"
            raise DatasetError(path, f"{place}: {name}", problem, remedy)
    return part


def _follows_or_unknown(
    observations: Mapping[str, np.ndarray], following: Mapping[str, np.ndarray], known: np.ndarray
) -> np.ndarray:
    return follows(observations, following) | ~known


def _concatenated(arrays: Sequence[np.ndarray], path: str | os.PathLike, name: str) -> np.ndarray:
    shapes = {array.shape[1:] for array in arrays}
    if len(shapes) > 1:
        problem = f"has rows of different shapes: {' and '.join(map(str, sorted(shapes)))}"
        raise DatasetError(path, name, problem, "Give trajectories of one environment")
    return np.concatenate(arrays)


def _guess_space(observations: Mapping[str, np.ndarray]) -> spaces.Space:
    if "observations" in observations:
        return guess_observation_space(observations["observations"])
    return spaces.Dict(
        {name.removeprefix("observations/"): guess_observation_space(array) for name, array in observations.items()}
    )


def _check_keys(space: spaces.Space, observations: Mapping[str, np.ndarray], path: str | os.PathLike) -> None:
    keys = {name.removeprefix("observations").removeprefix("/") for name in observations}
    wanted = set(space.spaces) if isinstance(space, spaces.Dict) else {""}
    if keys != wanted:
        found = f"have the keys {sorted(keys)}" if keys != {""} else "are plain arrays"
        problem = f"{found}, but the observation space is {space}"
        raise DatasetError(path, "observations", problem, "Give an observation_space that has the same keys")


class _ArraysOnly(pickle.Unpickler):
    """An unpickler that calls nothing but what rebuilds NumPy's arrays and Python's containers."""

    def find_class(self, module: str, name: str) -> Any:
        module = OLD_MODULES.get(module, module).replace("numpy.core", "numpy._core")
        if name not in SAFE_NAMES.get(module, ()):
            raise pickle.UnpicklingError(f"it holds a {module}.{name}, not arrays alone")
        try:
            return getattr(importlib.import_module(module), name)
        except ModuleNotFoundError:  # NumPy 1
            return getattr(importlib.import_module(module.replace("numpy._core", "numpy.core")), name)


def _unpickle(probe: Probe) -> Any:
    try:
        with open(probe.path, "rb") as file:
            return _ArraysOnly(file, encoding="latin1").load()  # NumPy's arrays in pickles of Python 2 need latin1
    except Exception as error:  # damaged pickles raise errors of all kinds
        remedy = (
            "If you trust the file, load it yourself and give the list of trajectories in place of the path (unpickling can "
            "run code, so only plain arrays are read here). If it is incomplete, copy it again"
        )
        raise DatasetError(probe.path, "trajectories", f"cannot be unpickled: {error}", remedy) from error


FORMAT = Format(
    name="trajectories",
    description=f"a list of dicts that have {' and '.join(REQUIRED)} each, or a pickle of such a list",
    recognizes=recognizes,
    read=read,
    declares_spaces=False,
)
