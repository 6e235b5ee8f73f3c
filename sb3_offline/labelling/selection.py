"""Selection of the episodes that are detected to solve a task, with labels that are made once."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import examples_checksum, load_examples
from sb3_offline.data.files import WriteLock
from sb3_offline.data.reader import DatasetLike, OfflineDataset, open_datasets
from sb3_offline.labelling.episodes import EpisodeLabels, label_episodes
from sb3_offline.labelling.side_file import load_labels, save_labels

#: Labels themselves, or the path of their file
LabelsLike = EpisodeLabels | str | os.PathLike


def select_detected(
    dataset: DatasetLike,
    detected: bool | int = True,
    *,
    labels: LabelsLike | None = None,
    examples: Any = None,
) -> list[OfflineDataset]:
    """
    Open datasets with only the episodes that look like successes.

    :param dataset: path, glob pattern, ``OfflineDataset``, or a sequence of these
    :param detected: ``True`` selects the detected episodes, a number that many of the best
    :param labels: labels of these data, or their file; see :func:`given_labels`
    :param examples: success examples, for labels that do not exist yet
    :return: the datasets that have such episodes, with these episodes alone
    :raises DatasetError: if no episode is detected, or if the labels belong to other data
    """
    datasets = open_datasets(dataset)
    known = given_labels(datasets, labels, examples)
    chosen = known.detected if detected is True else known.best(detected)
    if not chosen.any():
        problem = f"hold no episode that looks like the examples (detected={detected})"
        remedy = "Look at the best ones (sb3-offline label --html), and say how many to take"
        raise DatasetError(datasets[0].path, "episodes", problem, remedy)
    parts = np.split(chosen, np.cumsum([part.n_episodes for part in datasets])[:-1])
    return [part.select(np.flatnonzero(here)) for part, here in zip(datasets, parts, strict=True) if here.any()]


def given_labels(
    datasets: Sequence[OfflineDataset],
    labels: LabelsLike | None = None,
    examples: Any = None,
) -> EpisodeLabels:
    """
    Get the labels of some data. Given a file and examples, the labels are made and saved the first time and read from then
    on, so that several runs share them, also where they start at one time.

    :param datasets: open datasets
    :param labels: labels, or their file
    :param examples: success examples, for labels that do not exist yet
    :return: the labels; raises ``RuntimeError`` if neither labels nor examples are given, and ``DatasetError`` if the labels
        belong to other data, or if those of a file were made from other examples than the given ones
    """
    if isinstance(labels, EpisodeLabels):
        labels.check_data(datasets)
        return labels
    if labels is None:
        if examples is None:
            raise RuntimeError(
                "Detected episodes need `labels` (a file of sb3-offline label), or `examples` to make them from"
            )
        return label_episodes(datasets, examples)
    path = Path(labels).expanduser()
    if examples is None:
        return load_labels(path, datasets)
    if not path.exists():
        with WriteLock(path, wait=True) as lock:  # whoever comes second waits for the first, and reads what it wrote
            if not path.exists():
                made = label_episodes(datasets, examples)
                save_labels(path, made, {"examples": str(examples)}, lock=lock)
    known = load_labels(path, datasets)
    if known.made_with["examples_checksum"] != examples_checksum(load_examples(examples, datasets[0].observation_space)):
        raise DatasetError(
            path, "labels", f"were made from other examples than {examples}", "Remove the file, or name another"
        )
    return known
