"""Tools for several formats: flat transitions are cut into episodes, and spaces that are not declared are guessed."""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.format import Header
from sb3_offline.data.spaces import check_observations, check_rows


def cut_episodes(
    header: Header,
    path: str | os.PathLike,
    *,
    observations: Mapping[str, np.ndarray],
    next_observations: Mapping[str, np.ndarray] | None,
    known: np.ndarray,
    ends: np.ndarray,
    steps: Mapping[str, np.ndarray],
) -> dict[str, Any]:
    """
    Cut n transitions into episodes, in their order.

    Where the observation after the last step of an episode is unknown, it depends on how the episode ends. A terminated
    episode repeats the observation before the last step. Learners that stop at ``terminated`` never use the repeated
    observation; to learners that do not stop there, such as learners from success examples, the last step seems to change
    nothing. Any other episode ends one step earlier instead.

    :param header: spaces and optional arrays
    :param path: file for error messages
    :param observations: (n, ...) by array name, ``observations`` or ``observations/key``
    :param next_observations: (n, ...) by array name, the observations after the steps. Only last steps count
    :param known: (n,) bool, true if ``next_observations`` has the observation after the step
    :param ends: (n,) bool, true in the last step of each episode
    :param steps: all other arrays with one row for each step. Of ``terminated`` and ``truncated``, only last steps count
    :return: arrays by name, as ``Header.fields`` names them
    :raises DatasetError: if an array does not fit its space
    """
    last = np.flatnonzero(ends)
    first = np.append(0, last[:-1] + 1)
    lost = ~steps["terminated"][last] & ~known[last]
    kept = last + 1 - first - lost > 0
    first, last, lost = first[kept], last[kept], lost[kept]
    lengths = last + 1 - first - lost
    step_rows, observation_rows = _ranges(first, lengths), _ranges(first, lengths + 1)
    final = np.cumsum(lengths + 1) - 1  # rows of the last observations of the episodes
    # The observation before a lost step becomes the last one of its episode. Other episodes have no row after `last`.
    observation_rows[final] -= ~lost
    arrays: dict[str, Any] = {"episodes/length": lengths, "episodes/seed": np.full(len(lengths), -1, dtype=np.int64)}
    cut = {name: array[observation_rows] for name, array in observations.items()}
    for name, array in (next_observations or {}).items():
        cut[name][final[known[last]]] = array[last[known[last]]]
    arrays |= checked_observations(cut, header.observation_space, path)
    fields = header.fields()
    for name, array in steps.items():
        rows = array[step_rows]
        if name in ("terminated", "truncated"):
            rows = np.zeros(len(step_rows), dtype=bool)
            rows[np.cumsum(lengths) - 1] = array[last]
        arrays[name] = check_rows(rows, fields[name].shape, fields[name].dtype, None, path, name)
    return arrays


def follows(observations: Mapping[str, np.ndarray], following: Mapping[str, np.ndarray]) -> np.ndarray:
    """
    :param observations: (n, ...) by array name
    :param following: (n, ...) by array name, the observations after the steps
    :return: (n,) bool, true if the observation after the step is that of the next row; false in the last row
    """
    same = np.ones(len(next(iter(observations.values()))), dtype=bool)
    same[-1] = False
    for name, array in observations.items():
        same[:-1] &= (array[1:] == following[name][:-1]).reshape(len(array) - 1, -1).all(axis=1)
    return same


def lengths_so_far(ends: np.ndarray) -> np.ndarray:
    """
    :param ends: (n,) bool, true in the last step of each episode
    :return: (n,) number of steps from the beginning of the episode up to and including each step
    """
    index = np.arange(len(ends))
    starts = np.maximum.accumulate(np.where(np.append(True, ends[:-1]), index, 0))
    return index - starts + 1


def checked_observations(arrays: Mapping[str, np.ndarray], space: spaces.Space, path: str | os.PathLike) -> dict[str, Any]:
    """
    :param arrays: observations by array name, ``observations`` or ``observations/key``
    :param space: their space
    :param path: file for error messages
    :return: these arrays with the dtypes of the space
    :raises DatasetError: if they do not fit the space
    """
    value: Any = arrays["observations"] if "observations" in arrays else None
    if isinstance(space, spaces.Dict):
        value = {name.removeprefix("observations/"): array for name, array in arrays.items()}
    return check_observations(value, space, None, path)


def _ranges(starts: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """:return: the concatenation of ``arange(start, start + length)``"""
    offsets = np.cumsum(lengths) - lengths
    return np.arange(lengths.sum()) + np.repeat(starts - offsets, lengths)


def guess_observation_space(observations: np.ndarray) -> spaces.Box:
    """
    :param observations: (n, ...) observations without a declared space
    :return: a Box of their shape: 0 to 255 for uint8, unbounded for other dtypes
    """
    if observations.dtype == np.uint8:
        return spaces.Box(0, 255, observations.shape[1:], np.uint8)
    return spaces.Box(-np.inf, np.inf, observations.shape[1:], np.float32)


def guess_action_space(
    actions: np.ndarray, path: str | os.PathLike, format_name: str = "", name: str = "actions"
) -> spaces.Box:
    """
    :param actions: (n, ...) actions without a declared space
    :param path: file for error messages
    :param format_name: name of the format for error messages
    :param name: name of the actions in the file, for error messages
    :return: a Box of their shape with the bounds [-1, 1]
    :raises DatasetError: if the actions are integers, or if they exceed these bounds
    """
    remedy = (
        "Open it with OfflineDataset(path, action_space=...), or convert it with --env ID or --action-low and --action-high"
    )
    data = f"data of {format_name}" if format_name else "data of this format"
    if actions.dtype.kind != "f":
        problem = f"has dtype {actions.dtype}, and {data} do not declare which actions there are"
        raise DatasetError(path, name, problem, remedy)
    if actions.size and np.abs(actions).max() > 1 + 1e-5:
        problem = f"reaches from {actions.min():.4g} to {actions.max():.4g}, and {data} declare no bounds"
        raise DatasetError(path, name, problem, remedy)
    return spaces.Box(-1.0, 1.0, actions.shape[1:], np.float32)
