"""Draw success examples from a dataset with success labels."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import Observations
from sb3_offline.data.reader import DatasetLike, OfflineDataset, open_datasets
from sb3_offline.data.selection import check_source, of_source

PROGRAM = "sb3_offline.data_tools.converting.extract_examples"
"""Recorded in the files; it stays when this module moves."""


def extract_examples(
    dataset: DatasetLike,
    n: int = 200,
    *,
    source: str | None = None,
    seed: int = 0,
    held_out: bool = False,
    keys: Sequence[str] | None = None,
) -> tuple[Observations, dict[str, Any]]:
    """
    Draw observations of the solved task: those that follow a step labelled ``success``, uniformly and without repetition.

    :param dataset: path, glob pattern, ``OfflineDataset``, or a sequence of these
    :param n: number of examples
    :param source: use episodes of this source only, such as "door-open" in a file of several tasks
    :param seed: seed of the draw
    :param held_out: record that these episodes are kept out of the data to learn from
    :param keys: keys of dict observations to read (default: all)
    :return: ``(n, *shape)`` observations in the dataset's layout (a dict of arrays for a Dict space), and their provenance;
        raises ``DatasetError`` if there are no labels, too few successful steps, or no such key
    """
    datasets = open_datasets(dataset)
    names = [*datasets[0].observation_space] if isinstance(datasets[0].observation_space, spaces.Dict) else ["observations"]
    if keys is not None:
        if not set(keys) <= set(names) or names == ["observations"]:
            problem = f"has no {list(keys)} in its observation space, {datasets[0].observation_space}"
            raise DatasetError(datasets[0].path, "observations", problem, "Name keys of it, or leave them out (--keys)")
        names = [name for name in names if name in keys]
    if source is not None:
        check_source(datasets, source)
    steps_of = [_success_steps(part, source) for part in datasets]
    counts = [len(steps) for steps in steps_of]
    if sum(counts) < n:
        problem = f"holds {sum(counts)} steps with success{f' of source {source!r}' if source else ''}, fewer than {n}"
        raise DatasetError(datasets[0].path, "success", problem, "Ask for fewer examples, or collect more episodes")
    chosen = np.sort(np.random.default_rng(seed).choice(sum(counts), n, replace=False))
    origins, parts = [], []
    for part, steps, first in zip(datasets, steps_of, np.cumsum(counts) - counts, strict=True):
        mine = steps[chosen[(chosen >= first) & (chosen < first + len(steps))] - first]
        episodes = np.searchsorted(part.step_starts, mine, side="right") - 1
        rows = mine + episodes + 1  # the observation after the step; each earlier episode has one more row than it has steps
        parts.append(_rows(part, rows, names))
        origins.append({"file": part.path.name, "episodes": np.unique(episodes).tolist(), "provenance": part.provenance})
    provenance = {
        "program": PROGRAM,
        "n": n,
        "source": source,
        "seed": seed,
        "held_out": held_out,
        "datasets": origins,
    }
    arrays = {name: np.concatenate([p[name] for p in parts]) for name in names}
    return (arrays if isinstance(datasets[0].observation_space, spaces.Dict) else arrays["observations"]), provenance


def _success_steps(dataset: OfflineDataset, source: str | None) -> np.ndarray:
    if dataset.success is None:
        remedy = "Give success examples as an .npz file or a folder of images instead"
        raise DatasetError(dataset.path, "success", "is missing: the file has no success labels", remedy)
    wanted = np.asarray(dataset.success)
    if source is not None:
        wanted = wanted & np.repeat(of_source(dataset, source), dataset.lengths)
    return np.flatnonzero(wanted)


def _rows(dataset: OfflineDataset, rows: np.ndarray, names: Sequence[str]) -> dict[str, np.ndarray]:
    observations = dataset.observations
    arrays = observations if isinstance(observations, dict) else {"observations": observations}
    return {key: arrays[key][rows] for key in names}
