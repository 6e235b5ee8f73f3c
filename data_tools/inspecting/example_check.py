"""Compare success examples with a dataset: do the data hold similar observations?"""

import json
import os
from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np

from sb3_offline.data.examples import Observations, load_examples
from sb3_offline.data.spaces import subspaces
from sb3_offline.data_tools.inspecting.dataset_warnings import DataWarning
from sb3_offline.data_tools.inspecting.joined_datasets import JoinedDatasets

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
FEW_EPISODES = 10
"""Number of episodes from which examples show success in enough ways."""
WARNED_SHARE = 0.02
"""Share of far examples that causes no warning, because not every episode of a large file is compared."""

Features = list[np.ndarray]


def check_examples(
    data: JoinedDatasets, examples: str | os.PathLike | np.ndarray, seed: int = 0
) -> tuple[dict[str, Any], list[DataWarning]]:
    """
    Find the nearest observation to each example in a sample of the data. The data set the scale: the usual distance is that
    from an observation of one episode to the nearest observation of another episode.

    :param data: a dataset of at least one episode
    :param examples: in any form that learners take; raises ``DatasetError`` if they do not fit the observation space
    :param seed: seed of the sample
    :return: a summary in JSON types, and warnings. Distances are root mean squares over the values of an observation, each in
        standard deviations of the data.
    """
    observations = load_examples(examples, data.observation_space)
    arrays = _by_name(data, observations)
    rng = np.random.default_rng(seed)
    episodes, references = _sampled(data, rng)
    rows = np.concatenate([data.observation_starts[e] + np.arange(data.lengths[e] + 1) for e in episodes])
    of_episode = np.repeat(episodes, data.lengths[episodes] + 1)
    names = list(arrays)
    sample = [_features(data.arrays[name], rows) for name in names]
    scales = [_scale(part, len(data.arrays[name].shape) == 4) for name, part in zip(names, sample, strict=True)]
    frames = _standardised(sample, scales)
    given = _standardised([_features(arrays[name], np.arange(len(arrays[name]))) for name in names], scales)
    nearest, distance = _nearest(given, frames, np.full(len(given), -1), of_episode)
    places = np.searchsorted(rows, references)
    _, usual = _nearest(frames[places], frames, of_episode[places], of_episode)
    usual = usual[np.isfinite(usual)]  # with a single episode, there is no other one
    limit = TOLERANCE * float(usual.max()) if len(usual) else np.inf
    far = np.flatnonzero(distance > limit)
    identical = sum(
        all((arrays[name][i] == data.arrays[name][rows[nearest[i] : nearest[i] + 1]][0]).all() for name in names)
        for i in np.flatnonzero(distance < 1e-6)
    )
    provenance = _provenance(examples)
    summary = {
        "examples": str(examples) if isinstance(examples, str | os.PathLike) else "array",
        "count": len(given),
        "provenance": provenance,
        "compared_observations": len(rows),
        "identical": int(identical),
        "distances": distance.tolist(),
        "usual_distances": usual.tolist(),
        "far": far.tolist(),
    }
    warnings = []
    if len(far) > WARNED_SHARE * len(given):
        problem = (
            f"{len(far)} of {len(given)} are unlike every observation of the data (by up to {distance.max():.3g} standard "
        )
        problem += f"deviations; the data's own episodes differ by up to {usual.max():.3g})"
        remedy = "Check camera, crop, colours and units, or draw them from the same kind of data (sb3-offline examples)"
        warnings.append(DataWarning("examples", problem, remedy))
    warnings += few_episodes(provenance)
    if provenance.get("held_out") and identical:
        problem = f"{identical} of {len(given)} are observations of this data, but are recorded as held out from it"
        warnings.append(DataWarning("examples", problem, "Draw them from other episodes, or without --held-out"))
    return summary, warnings


def few_episodes(provenance: Mapping[str, Any]) -> list[DataWarning]:
    """
    :param provenance: of examples that ``extract_examples`` drew; others say nothing of
        their episodes
    :return: a warning where many examples come from few episodes
    """
    n_episodes = sum(len(origin["episodes"]) for origin in provenance.get("datasets", []))
    n_examples = provenance.get("n", 0)
    if not 0 < n_episodes < min(FEW_EPISODES, n_examples):
        return []
    problem = (
        f"{n_examples} come from {n_episodes} episode{'s' * (n_episodes > 1)}, and frames of one episode are nearly alike"
    )
    return [DataWarning("examples", f"{problem}: they teach hardly more than {n_episodes}", "Draw them from more episodes")]


def _by_name(data: JoinedDatasets, observations: Observations) -> dict[str, np.ndarray]:
    """:return: the examples by the names of the data's arrays, of which they may lack some"""
    names = subspaces(data.observation_space, "observations")
    if isinstance(observations, dict):
        by_name = {name: observations.get(name.removeprefix("observations/")) for name in names}
        return {name: array for name, array in by_name.items() if array is not None}
    return dict.fromkeys(names, observations)


def _provenance(examples: Any) -> dict[str, Any]:
    if not (isinstance(examples, str | os.PathLike) and h5py.is_hdf5(examples)):
        return {}
    with h5py.File(examples, "r", locking=False) as file:
        return json.loads(file.attrs["provenance"])


def _sampled(data: JoinedDatasets, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """
    :return: indices of whole episodes, half of them successful if there are enough; and rows of observations to measure usual
        distances with, which show solved states if there are labels
    """
    row_bytes = sum(
        int(np.prod(data.arrays[name].shape[1:])) * data.arrays[name].dtype.itemsize
        for name in subspaces(data.observation_space, "observations")
    )
    rows = min(COMPARED_ROWS, max(COMPARED_BYTES // row_bytes, 1))
    n = max(int(rows / (data.lengths.mean() + 1)), 2)
    order = rng.permutation(data.n_episodes)
    solved = data.solved()
    if solved is not None:
        order = np.concatenate([order[solved[order]][: n // 2], order[~solved[order]], order[solved[order]][n // 2 :]])
    episodes = np.sort(order[:n])
    steps = np.concatenate([data.step_starts[e] + np.arange(data.lengths[e]) for e in episodes])
    if data.success is not None and data.success[steps].any():
        steps = steps[data.success[steps]]
    steps = rng.choice(steps, min(REFERENCES, len(steps)), replace=False)
    return episodes, steps + np.searchsorted(data.step_starts, steps, side="right")


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
