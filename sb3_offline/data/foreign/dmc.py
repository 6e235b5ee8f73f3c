"""Episodes of the DeepMind Control suite, as ExORL, V-D4RL and Dreamer store them in ``.npz`` and HDF5 files."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import open_hdf5
from sb3_offline.data.foreign.base import Foreign, Format, Options
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.foreign.recorded import (
    HDF5_SUFFIXES,
    Episode,
    any_file,
    chosen,
    files_in,
    flattened,
    join_episodes,
    read_npz,
    readable,
)

NAME = "ExORL/V-D4RL/DMC"
SUFFIXES = (".npz", *HDF5_SUFFIXES)
OBSERVATIONS = ("observation", "image")
# At least one of these tells such a file from other ones with an action and an observation.
MARKS = ("discount", "step_type", "is_first", "is_last", "is_terminal")
READ = ("action", "reward", *MARKS)
FIRST, LAST = 0, 2  # values of dm_env's StepType


def recognizes(probe: Probe) -> bool:
    """
    :param probe: a path or an object
    :return: whether it is an ``.npz`` or HDF5 file with such episodes, or a folder of these
    """
    if probe.kind == "folder":
        return any_file(files_in(probe.path, SUFFIXES), recognizes)
    has_observations = set(OBSERVATIONS) & probe.names
    return probe.kind in ("zip", "HDF5") and "action" in probe.names and bool(has_observations and set(MARKS) & probe.names)


def read(probe: Probe, options: Options) -> Foreign:
    """
    Read episodes into memory.

    The first row of an episode is that of the reset: its action is a dummy. Each further row holds the action that led to its
    observation, and the reward. An episode terminated if ``is_terminal`` is true or ``discount`` is 0 in its last row, and was
    truncated by the time limit otherwise. If ``is_last`` or ``step_type`` say that the last row is not the end of the episode,
    it ends with neither flag.

    :param probe: the file or the folder
    :param options: ``observation_space`` (default: ``observation`` or ``image``, or a Dict if there are both; a Dict may name
        any arrays) and ``action_space`` (default: [-1, 1])
    :return: the data
    """
    path = probe.path
    files = files_in(path, SUFFIXES) if probe.kind == "folder" else [path]
    episodes = [episode for file in files for episode in _episodes(file, options)]
    return join_episodes(episodes, path, options, NAME)


def _episodes(path: Path, options: Options) -> Iterator[Episode]:
    with Probe(path) as probe:
        if probe.kind == "HDF5":
            with readable(path), open_hdf5(path) as file:
                raw = {name: array[()] for name, array in flattened(file).items()}
        else:
            raw = read_npz(path)
    if "action" not in raw or not set(OBSERVATIONS) & raw.keys():
        missing = "action" if "action" not in raw else " or ".join(OBSERVATIONS)
        raise DatasetError(path, missing, f"is missing: the file holds {sorted(raw)}", "Remove the file, or record it again")
    n = len(raw["action"]) if raw["action"].ndim else 0
    for name in list(raw):
        if raw[name].ndim == 0 or len(raw[name]) != n:
            if name in (*READ, *OBSERVATIONS):
                problem = f"has shape {raw[name].shape}, but action has {n} rows"
                raise DatasetError(path, name, problem, "Each array has one row for each observation. Record the file again")
            del raw[name]  # such as the settings of the recording
    flags = _marks(raw, path)
    space = options.observation_space
    found = {name: array for name, array in raw.items() if name not in READ}
    known = {name: array for name, array in found.items() if name in OBSERVATIONS}
    keys: Mapping[str, np.ndarray] = chosen(found if hasattr(space, "spaces") else known, space, path, "observation")
    observed = {id(array) for array in keys.values()}
    if space is None and len(keys) == 1:
        keys = {"": next(iter(keys.values()))}
    # An episode begins in the first row, in the rows that are marked so, and after the ends of others.
    begins = flags["is_first"] | np.append(True, flags["is_last"][:-1])[:n] if n else np.zeros(0, dtype=bool)
    starts = np.flatnonzero(begins)
    for start, stop in zip(starts, np.append(starts[1:], n), strict=True):
        steps = {"actions": raw["action"][start + 1 : stop]}
        if "reward" in raw:
            steps["rewards"] = raw["reward"][start + 1 : stop]
        terminated = bool(flags["is_terminal"][stop - 1])
        ended = terminated or not flags["marked"][start] or bool(flags["is_last"][stop - 1])
        extras = {name: array[start:stop] for name, array in found.items() if id(array) not in observed}
        if "discount" in raw and not np.isin(raw["discount"], (0, 1)).all():
            extras["discount"] = raw["discount"][start + 1 : stop]
        yield Episode(
            path,
            "",
            {key: array[start:stop] for key, array in keys.items()},
            steps,
            extras,
            terminated=terminated,
            truncated=ended and not terminated,
        )


def _marks(raw: Mapping[str, np.ndarray], path: Path) -> dict[str, np.ndarray]:
    """:return: (n,) bool for each of is_first, is_last, is_terminal and ``marked``, which tells whether the file marks ends"""
    n = len(raw["action"])
    for name in MARKS:
        if name in raw and raw[name].size != n:
            raise DatasetError(path, name, f"has shape {raw[name].shape}, expected ({n},)", "Record the file again")
    marks = {name: raw[name].reshape(n) for name in MARKS if name in raw}
    nowhere = np.zeros(n, dtype=bool)
    step_type, discount = marks.get("step_type"), marks.get("discount")
    is_first = marks.get("is_first", nowhere if step_type is None else step_type == FIRST)
    is_last = marks.get("is_last", nowhere if step_type is None else step_type == LAST)
    is_terminal = marks.get("is_terminal", nowhere if discount is None else discount == 0)
    marked = np.full(n, "is_last" in marks or step_type is not None)
    found = {"is_first": is_first, "is_last": is_last, "is_terminal": is_terminal, "marked": marked}
    return {name: np.asarray(flags, dtype=bool) for name, flags in found.items()}


FORMAT = Format(
    name=NAME,
    description="an .npz or HDF5 file, or a folder of these, with action, observation or image, and discount or is_first",
    recognizes=recognizes,
    read=read,
    declares_spaces=False,
)
