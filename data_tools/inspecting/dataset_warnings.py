"""Likely mistakes in a dataset, each with a remedy."""

import hashlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_offline.data.spaces import subspaces
from sb3_offline.data_tools.inspecting.array_statistics import ArrayStatistics
from sb3_offline.data_tools.inspecting.joined_datasets import JoinedDatasets


class DataWarning(NamedTuple):
    """The parts of a ``DatasetError``, for a dataset that remains usable."""

    field: str
    problem: str
    remedy: str


def find_warnings(data: JoinedDatasets, arrays: dict[str, ArrayStatistics]) -> list[DataWarning]:
    """
    :param data: a dataset of at least one episode
    :param arrays: from ``array_statistics``
    :return: likely mistakes
    """
    found = [*_left_out_warnings(data), *_action_warnings(data), *_label_warnings(data)]
    plain = subspaces(data.observation_space, "observations")
    for name, statistics in arrays.items():
        is_label = name.startswith("episodes/") or statistics.array.dtype == bool
        if statistics.images is not None:
            found += _image_warnings(name, statistics.images)
        elif not is_label:
            found += _field_warnings(name, statistics, plain.get(name))
    return [*found, *_duplicate_warnings(data)]


def _left_out_warnings(data: JoinedDatasets) -> Iterator[DataWarning]:
    remedy = "Inspect these files one by one, or write them again with the same arrays"
    for name in data.left_out:
        yield DataWarning(name, "is not in all of the files in one shape and dtype: left out", remedy)


def _action_warnings(data: JoinedDatasets) -> Iterator[DataWarning]:
    if not isinstance(data.action_space, spaces.Box):
        return
    flat = data.actions.reshape(data.n_steps, -1)
    low, high = data.action_space.low.reshape(-1), data.action_space.high.reshape(-1)
    slack = 1e-4 * (high - low) / 2
    outside = ((flat < low - slack) | (flat > high + slack)).any(axis=1).mean()
    if outside:
        remedy = "Learners clip them: scale them, or write the file with the action space in which they were recorded"
        yield DataWarning("actions", f"{outside:.1%} of the steps are outside the action space", remedy)


def _label_warnings(data: JoinedDatasets) -> Iterator[DataWarning]:
    if data.success is not None and data.success.all():
        remedy = "Check how it was computed: examples drawn from these steps could show any state"
        yield DataWarning("success", "every step is labelled a success", remedy)
    if data.success is not None and not data.success.any():
        remedy = "Check how it was computed, or give success examples from elsewhere"
        yield DataWarning("success", "no step is labelled a success", remedy)
    neither = int((~data.terminated & ~data.truncated)[data.step_starts + data.lengths - 1].sum())
    if neither:
        remedy = "This is right if collection stopped there; otherwise label the last step of each"
        yield DataWarning("terminated, truncated", f"{neither} episodes end without either", remedy)


def _field_warnings(name: str, statistics: ArrayStatistics, space: spaces.Space | None) -> Iterator[DataWarning]:
    """Report NaN, constant columns, and values outside the observation space."""
    low, high = statistics.low, statistics.high
    if statistics.n_bad:
        remedy = "Leave out these episodes, or this array. Learners do not read extras, but `render` does"
        yield DataWarning(name, f"{statistics.n_bad} rows hold NaN or infinity", remedy)
    constant = np.flatnonzero(low == high)
    if len(statistics.array) > 1 and len(constant):
        columns = "" if low.size == 1 else f" in {len(constant)} of {low.size} columns ({_some(constant)})"
        remedy = "Check that it was recorded; a constant value tells a learner nothing"
        yield DataWarning(name, f"never changes{columns}", remedy)
    if isinstance(space, spaces.Box):
        outside = np.flatnonzero((low < space.low.reshape(-1)) | (high > space.high.reshape(-1)))
        if len(outside):
            problem = f"outside the observation space in {len(outside)} columns ({_some(outside)})"
            yield DataWarning(name, problem, "Check units and scaling, or write the file with a wider space")


def _image_warnings(name: str, images: np.ndarray) -> Iterator[DataWarning]:
    """:param images: (n, values), sampled and flattened"""
    if not np.isfinite(images).all():
        yield DataWarning(name, "images hold NaN or infinity", "Leave out their episodes")
        return
    n = len(images)
    blank = (images == images[:, :1]).all(axis=1).mean() if n else 0
    if blank:
        remedy = "Check the camera and the renderer: nothing was drawn"
        yield DataWarning(name, f"{blank:.1%} of {n} sampled images are of one colour", remedy)
    elif n > 1 and (images == images[0]).all():
        yield DataWarning(name, f"all of {n} sampled images are the same", "Check that a new image was drawn at each step")
    if n and images.dtype == np.uint8 and images.max() <= 1:
        remedy = "Multiply them by 255 before the cast"
        yield DataWarning(name, "the sampled images hold only 0 and 1, as if cast to uint8 from [0, 1]", remedy)


def _duplicate_warnings(data: JoinedDatasets) -> Iterator[DataWarning]:
    """Report episodes with the same actions and the same first and last observations."""
    by_actions: dict[bytes, list[int]] = {}
    for episode, (start, length) in enumerate(zip(data.step_starts, data.lengths, strict=True)):
        digest = _digest(data.actions[start : start + length])
        by_actions.setdefault(digest, []).append(episode)
    # Observations may be images, so only those of possible duplicates are read
    suspects = np.array([episode for alike in by_actions.values() if len(alike) > 1 for episode in alike], dtype=np.int64)
    first = data.observation_starts[suspects]
    names = subspaces(data.observation_space, "observations")
    ends = [data.arrays[name][rows] for name in names for rows in (first, first + data.lengths[suspects])]
    seen: dict[tuple[bytes, ...], int] = {}
    duplicates = []
    for index in np.argsort(suspects):
        episode = int(suspects[index])
        start, length = data.step_starts[episode], data.lengths[episode]
        key = (_digest(data.actions[start : start + length]), *(_digest(end[index]) for end in ends))
        if seen.setdefault(key, episode) != episode:
            duplicates.append(episode)
    if duplicates:
        remedy = "Leave them out: they count twice in training. Give each collector its own seed"
        yield DataWarning("episodes", f"{len(duplicates)} repeat an earlier one ({_some(np.array(duplicates))})", remedy)


def _digest(array: np.ndarray) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=16).digest()


def _some(indices: np.ndarray) -> str:
    return ", ".join(map(str, indices[:8].tolist())) + (", ..." if len(indices) > 8 else "")
