"""Episodes of datasets chosen by their labels: what was attempted (``source``), and whether it succeeded (``success``)."""

from collections.abc import Sequence

import numpy as np

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import DatasetSource, OfflineDataset, open_datasets


def select_episodes(dataset: DatasetSource, *, source: str | None = None, success: bool | None = None) -> list[OfflineDataset]:
    """
    Open datasets with some of their episodes only, e.g. for the imitation of successful ones.

    :param dataset: path, glob pattern, ``OfflineDataset``, or a sequence of these
    :param source: episodes of this source only, e.g. "door-open" in a file of attempts at several tasks
    :param success: episodes that were solved at one step at least (``True``), or at none (``False``)
    :return: the datasets that hold such episodes, with these alone; raises ``DatasetError`` where there is no such episode, or
        no such label
    """
    chosen, datasets = [], open_datasets(dataset)
    if source is not None:
        check_source(datasets, source)
    for part in datasets:
        wanted = np.ones(part.n_episodes, dtype=bool) if source is None else of_source(part, source)
        if success is not None:
            if part.success is None:
                remedy = "Take all episodes, or collect data with success labels"
                raise DatasetError(part.path, "success", "is missing: the file has no success labels", remedy)
            wanted &= np.logical_or.reduceat(part.success, part.step_starts) == success
        if wanted.any():
            chosen.append(part.select(np.flatnonzero(wanted)))
    if not chosen:
        problem = f"holds no episode with source={source!r} and success={success}"
        raise DatasetError(datasets[0].path, "episodes", problem, "Collect more episodes, or choose other ones")
    return chosen


def check_source(datasets: Sequence[OfflineDataset], source: str) -> None:
    """Raise ``DatasetError`` where a dataset has no labels of its episodes' sources, or none of them knows this one."""
    known = list(dict.fromkeys(name for dataset in datasets for name in dataset.sources))
    for dataset in datasets:
        if dataset.source is None or source not in known:
            raise DatasetError(dataset.path, "source", f"has no {source!r}", f"The sources are {known}")


def of_source(dataset: OfflineDataset, source: str) -> np.ndarray:
    """
    :param dataset: with labels of its episodes' sources
    :param source: one of them, or of another dataset's
    :return: (E,) bool, which episodes are of this source
    """
    if dataset.source is None or source not in dataset.sources:
        return np.zeros(dataset.n_episodes, dtype=bool)
    return dataset.source == dataset.sources.index(source)
