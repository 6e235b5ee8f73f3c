"""Selection of episodes by their labels: what was attempted (``source``), and whether it succeeded (``success``)."""

from collections.abc import Sequence

import numpy as np

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import DatasetLike, OfflineDataset, open_datasets


def select_episodes(dataset: DatasetLike, *, source: str | None = None, success: bool | None = None) -> list[OfflineDataset]:
    """
    Open datasets with only some of their episodes, e.g. to imitate the successful ones.

    :param dataset: path, glob pattern, ``OfflineDataset``, or a sequence of these
    :param source: label of the episodes to select, e.g. "door-open" in a file of attempts at several tasks (default: all)
    :param success: ``True`` selects episodes that were solved at any step, ``False`` those that never were (default: all)
    :return: the datasets that have such episodes, with these episodes alone
    :raises DatasetError: if there is no such episode, no such source, or no success labels
    """
    selected, datasets = [], open_datasets(dataset)
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
            selected.append(part.select(np.flatnonzero(wanted)))
    if not selected:
        problem = f"holds no episode with source={source!r} and success={success}"
        raise DatasetError(datasets[0].path, "episodes", problem, "Collect more episodes, or select others")
    return selected


def check_source(datasets: Sequence[OfflineDataset], source: str) -> None:
    """
    :param datasets: open datasets
    :param source: label of episodes
    :raises DatasetError: if a dataset has no labels of its episodes' sources, or if none of the datasets has this label
    """
    labels = list(dict.fromkeys(label for dataset in datasets for label in dataset.sources))
    for dataset in datasets:
        if dataset.source is None or source not in labels:
            raise DatasetError(dataset.path, "source", f"has no {source!r}", f"The sources are {labels}")


def of_source(dataset: OfflineDataset, source: str) -> np.ndarray:
    """
    :param dataset: an open dataset
    :param source: label of episodes
    :return: (E,) bool, true for the episodes with this label
    """
    if dataset.source is None or source not in dataset.sources:
        return np.zeros(dataset.n_episodes, dtype=bool)
    return dataset.source == dataset.sources.index(source)
