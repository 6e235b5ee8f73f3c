"""The distance of success examples from a dataset: do the data hold similar observations?"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_offline.data.examples import Observations
from sb3_offline.data.spaces import subspaces

COMPARED_ROWS, COMPARED_BYTES = 500_000, 1 << 28
"""Largest sample of the data that examples are compared with: all states of most files, or 20,000 images of 64 x 64."""
GRID = 16
"""Number of cells in each direction. Images are compared by the means of their cells."""
PIECE = 512
"""Number of rows read at once."""
REFERENCES = 200
"""Number of observations that measure the usual distance between episodes."""
TOLERANCE = 1.5
"""An example is far from the data if its distance exceeds the largest usual distance by this factor."""
WARNED_SHARE = 0.02
"""Share of far examples that causes no warning, because not every episode of a large file is compared."""

Features = list[np.ndarray]


class ExampleGap(NamedTuple):
    """
    Success examples compared with a sample of the data. Distances are root mean squares over the values of an observation,
    each in standard deviations of the data.

    :param compared: number of observations in the sample
    :param identical: number of examples that are observations of the sample
    :param distances: (n,) from each example to the nearest observation
    :param usual_distances: from observations of the data to the nearest observation of another episode
    :param far: indices of the examples that are farther from the data than the data's episodes from each other
    """

    compared: int
    identical: int
    distances: np.ndarray
    usual_distances: np.ndarray
    far: np.ndarray

    def problem(self) -> tuple[str, str] | None:
        """:return: problem and remedy, if the examples do not fit the data"""
        n = len(self.distances)
        if len(self.far) <= WARNED_SHARE * n:
            return None
        problem = (
            f"{len(self.far)} of {n} are unlike every observation of the data (by up to {self.distances.max():.3g} standard "
            f"deviations; the data's own episodes differ by up to {self.usual_distances.max():.3g})"
        )
        return problem, "Check camera, crop, colours and units, or draw them from the same kind of data (sb3-offline examples)"


def example_gap(
    observation_space: spaces.Space,
    arrays: Mapping[str, Any],
    lengths: np.ndarray,
    examples: Observations,
    *,
    success: np.ndarray | None = None,
    seed: int = 0,
) -> ExampleGap:
    """
    Find the nearest observation to each example in a sample of the data. The data set the scale: the usual distance is that
    from an observation of one episode to the nearest observation of another episode.

    :param observation_space: space of the data's observations
    :param arrays: the data's arrays of observations by name; of dict observations, only those of the examples are compared
    :param lengths: (E,) steps of each episode
    :param examples: in the layout of this space, from :func:`~sb3_offline.data.examples.load_examples`
    :param success: (N,) bool, labels, so that successes are compared with more successes
    :param seed: seed of the sample
    :return: the comparison
    """
    given_arrays = _by_name(observation_space, examples)
    names = list(given_arrays)
    rng = np.random.default_rng(seed)
    episodes, references = _sampled([arrays[name] for name in names], lengths, success, rng)
    observation_starts = np.cumsum(lengths + 1) - lengths - 1
    rows = np.concatenate([observation_starts[e] + np.arange(lengths[e] + 1) for e in episodes])
    of_episode = np.repeat(episodes, lengths[episodes] + 1)
    sample = [_features(arrays[name], rows) for name in names]
    scales = [_scale(part, len(arrays[name].shape) == 4) for name, part in zip(names, sample, strict=True)]
    frames = _standardised(sample, scales)
    given = _standardised([_features(given_arrays[name], np.arange(len(given_arrays[name]))) for name in names], scales)
    nearest, distance = _nearest(given, frames, np.full(len(given), -1), of_episode)
    places = np.searchsorted(rows, references)
    _, usual = _nearest(frames[places], frames, of_episode[places], of_episode)
    usual = usual[np.isfinite(usual)]  # with a single episode, there is no other one
    limit = TOLERANCE * float(usual.max()) if len(usual) else np.inf
    identical = sum(
        all((given_arrays[name][i] == arrays[name][rows[nearest[i] : nearest[i] + 1]][0]).all() for name in names)
        for i in np.flatnonzero(distance < 1e-6)
    )
    return ExampleGap(len(rows), int(identical), distance, usual, np.flatnonzero(distance > limit))


def _by_name(space: spaces.Space, observations: Observations) -> dict[str, np.ndarray]:
    names = subspaces(space, "observations")
    if isinstance(observations, dict):
        keys = {name: name.removeprefix("observations/") for name in names}
        return {name: observations[key] for name, key in keys.items() if key in observations}
    return dict.fromkeys(names, observations)


def _sampled(
    arrays: list[Any], lengths: np.ndarray, success: np.ndarray | None, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """
    :return: indices of whole episodes, half of them successful if there are enough; and rows of observations to measure usual
        distances with, which show solved states if there are labels
    """
    step_starts = np.cumsum(lengths) - lengths
    row_bytes = sum(int(np.prod(array.shape[1:])) * array.dtype.itemsize for array in arrays)
    rows = min(COMPARED_ROWS, max(COMPARED_BYTES // row_bytes, 1))
    n = max(int(rows / (lengths.mean() + 1)), 2)
    order = rng.permutation(len(lengths))
    if success is not None:
        solved = np.logical_or.reduceat(success, step_starts)
        order = np.concatenate([order[solved[order]][: n // 2], order[~solved[order]], order[solved[order]][n // 2 :]])
    episodes = np.sort(order[:n])
    steps = np.concatenate([step_starts[e] + np.arange(lengths[e]) for e in episodes])
    if success is not None and success[steps].any():
        steps = steps[success[steps]]
    steps = rng.choice(steps, min(REFERENCES, len(steps)), replace=False)
    return episodes, steps + np.searchsorted(step_starts, steps, side="right")


def _features(array: Any, rows: np.ndarray) -> np.ndarray:
    """
    :param array: array of observations
    :param rows: (n,) int, ascending
    :return: (n, features) float32: plain vectors, or the means of the cells of images
    """
    is_image = len(array.shape) == 4
    # Slices instead of scattered rows, for which compressed storage would read a chunk once per row
    runs = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
    pieces = [run[first : first + PIECE] for run in runs for first in range(0, len(run), PIECE)]
    features = []
    for piece in pieces:
        values = np.asarray(array[int(piece[0]) : int(piece[-1]) + 1])
        features.append(_cells(values) if is_image else values.reshape(len(piece), -1).astype(np.float32))
    return np.concatenate(features)


def _cells(images: np.ndarray) -> np.ndarray:
    """:param images: (n, height, width, channels) or (n, channels, height, width)"""
    sums: np.ndarray = images.astype(np.float32)
    for axis in (1, 2, 3):
        size = sums.shape[axis]
        if size > GRID:
            edges = np.linspace(0, size, GRID, endpoint=False).astype(int)
            shape = [-1 if i == axis else 1 for i in range(4)]
            sums = np.add.reduceat(sums, edges, axis=axis) / np.diff([*edges, size]).reshape(shape)
    return sums.reshape(len(images), -1)


def _scale(sample: np.ndarray, is_image: bool) -> tuple[np.ndarray, np.ndarray]:
    """
    :return: mean and standard deviation. All cells of an image share one deviation, since some cells never change. The
        deviation of a vector's value is at least a millionth, so that a value that never changes may differ slightly.
    """
    mean, variance = sample.mean(axis=0, dtype=np.float64), sample.var(axis=0, dtype=np.float64)
    std = np.sqrt(np.full_like(variance, variance.mean()) if is_image else variance)
    return mean.astype(np.float32), np.maximum(std, 1e-6 + 1e-6 * np.abs(mean)).astype(np.float32)


def _standardised(parts: Features, scales: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """:return: (n, features), scaled so that the parts of a dict weigh the same and the sum of squares is a mean"""
    scaled = [
        (part - mean) / std / np.sqrt(part.shape[1] * len(parts)) for part, (mean, std) in zip(parts, scales, strict=True)
    ]
    return np.concatenate(scaled, axis=1)


def _nearest(
    given: np.ndarray, frames: np.ndarray, own_episode: np.ndarray, of_episode: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    :param given: (n, features) observations
    :param frames: (m, features) observations of the data
    :param own_episode: (n,) index of the episode that must not count, or -1
    :param of_episode: (m,) index of the episode of each frame
    :return: (n,) row of the nearest frame of another episode, and (n,) its distance, infinite if there is none
    """
    squares = (frames**2).sum(axis=1)
    rows = np.zeros(len(given), np.int64)
    for first in range(0, len(given), 64):
        part = slice(first, first + 64)
        costs = squares - 2 * given[part] @ frames.T
        costs[own_episode[part, None] == of_episode] = np.inf
        rows[part] = costs.argmin(axis=1)
    distance = np.sqrt(((given - frames[rows]) ** 2).sum(axis=1, dtype=np.float64))
    return rows, np.where(of_episode[rows] == own_episode, np.inf, distance)
