"""Labels on disk: a small file beside the data, or a copy of the data with these labels."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sb3_offline.common.provenance import TRAINING_PACKAGES, current_commit, installed_versions
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import WriteLock, open_hdf5, replacing
from sb3_offline.data.plain import check_all_plain, is_text, read_attribute
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.spaces import subspaces
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.labelling.episodes import EpisodeLabels, Estimate

LABELS_FORMAT, LABELS_VERSION = "sb3-offline-labels", 1
REMEDY = "Label the data again (sb3-offline label)"
ESTIMATES = ("precision", "successes")
ARRAYS = {
    "probabilities": np.float32,
    "episodes/length": np.int64,
    "episodes/ranking": np.float32,
    "episodes/score": np.float32,
}


def save_labels(
    path: str | os.PathLike,
    labels: EpisodeLabels,
    provenance: Mapping[str, Any] | None = None,
    *,
    overwrite: bool = True,
    lock: WriteLock | None = None,
) -> None:
    """
    Write labels to an HDF5 file. It holds no data, but a checksum of the data that the labels belong to. For other programs,
    it also has ``success`` and ``episodes/detected``.

    :param path: the file; it may begin with ``~``
    :param labels: the labels
    :param provenance: origin of the labels (JSON)
    :param overwrite: replace an existing file
    :param lock: the lock of the file, if the caller holds it
    :raises DatasetError: if the file exists and ``overwrite`` is false
    """
    path = Path(path).expanduser()
    if path.exists() and not overwrite:
        raise DatasetError(path, "file", "exists already", "Give --overwrite to replace it")
    with replacing(path, lock) as temporary, h5py.File(temporary, "w", locking=False) as file:
        file.attrs["format"], file.attrs["format_version"] = LABELS_FORMAT, LABELS_VERSION
        file.attrs["data_checksum"] = labels.checksum
        for name in ESTIMATES:
            file.attrs[f"estimated_{name}"] = getattr(labels, f"estimated_{name}")
        file.attrs["made_with"] = json.dumps(dict(labels.made_with))
        file.attrs["warnings"] = json.dumps(list(labels.warnings))
        file.attrs["provenance"] = json.dumps(label_provenance(provenance))
        arrays = (labels.probabilities, labels.lengths, labels.ranking, labels.scores)
        for (name, dtype), array in zip(ARRAYS.items(), arrays, strict=True):
            file.create_dataset(name, data=np.asarray(array, dtype))
        file.create_dataset("success", data=labels.success)
        file.create_dataset("episodes/detected", data=labels.detected)


def load_labels(path: str | os.PathLike, datasets: Sequence[OfflineDataset] | None = None) -> EpisodeLabels:
    """
    :param path: a file of :func:`save_labels`
    :param datasets: open datasets that the labels must belong to
    :return: the labels
    :raises DatasetError: if the file is no such file, is damaged, or belongs to other data
    """
    path = Path(path).expanduser()
    with open_hdf5(path) as file:
        found, version = (read_attribute(file, name) for name in ("format", "format_version"))
        if not is_text(found, LABELS_FORMAT) or version != LABELS_VERSION:
            problem = f"is {found!r} version {version}, expected {LABELS_FORMAT!r} {LABELS_VERSION}"
            raise DatasetError(path, "attribute format", problem, REMEDY)
        check_all_plain(file, path)
        try:
            arrays = [np.asarray(file[name][()], dtype) for name, dtype in ARRAYS.items()]
            precision, successes = (Estimate(*map(float, file.attrs[f"estimated_{name}"])) for name in ESTIMATES)
            made_with, warnings = (json.loads(file.attrs[name]) for name in ("made_with", "warnings"))
            checksum = int(file.attrs["data_checksum"])
        except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
            raise DatasetError(path, "file", f"cannot be read ({' '.join(str(error).split())})", REMEDY) from error
    probabilities, lengths, ranking, scores = arrays
    if not (len(lengths) == len(ranking) == len(scores) and lengths.sum() == len(probabilities) and (lengths > 0).all()):
        raise DatasetError(path, "episodes/length", "does not fit the other arrays", REMEDY)
    labels = EpisodeLabels(probabilities, lengths, ranking, scores, precision, successes, checksum, made_with, warnings)
    if datasets is not None:
        labels.check_data(datasets, path)
    return labels


def label_provenance(more: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """
    :param more: what the caller knows, such as the examples' file
    :return: which program made labels
    """
    packages = installed_versions(TRAINING_PACKAGES)
    return {"program": "sb3_offline.label_episodes", "commit": current_commit(), "versions": packages, **(more or {})}


def write_labelled_copy(
    path: str | os.PathLike,
    dataset: OfflineDataset,
    labels: EpisodeLabels,
    provenance: Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """
    Copy a dataset with these labels as its success labels; those that it may have are left out.

    :param path: the file to write
    :param dataset: the data
    :param labels: labels of these data
    :param provenance: origin of the labels (JSON)
    :param overwrite: replace an existing file
    :raises DatasetError: if the labels belong to other data, or if the file exists and ``overwrite`` is false
    """
    labels.check_data([dataset])
    names, extras = subspaces(dataset.observation_space, "observations"), dataset.header.extras
    with DatasetWriter(
        path,
        dataset.observation_space,
        dataset.action_space,
        env_id=dataset.env_id,
        env_kwargs=dataset.env_kwargs,
        provenance={**dataset.provenance, "labelled": {**label_provenance(provenance), **labels.made_with}},
        mode="w" if overwrite else "x",
        rewards=dataset.rewards is not None,
        extras=extras,
        sources=dataset.sources if dataset.source is not None else None,
        capacity=(dataset.n_episodes, dataset.n_steps),
    ) as writer:
        for e, (first, length) in enumerate(zip(dataset.step_starts.tolist(), dataset.lengths.tolist(), strict=True)):
            steps, row = slice(first, first + length), int(dataset.observation_starts[e])
            parts = {name.removeprefix("observations/"): dataset.arrays[name][row : row + length + 1] for name in names}
            writer.add_episode(
                parts if isinstance(dataset.observations, dict) else parts["observations"],
                dataset.actions[steps],
                rewards=None if dataset.rewards is None else dataset.rewards[steps],
                terminated=dataset.terminated[steps],
                truncated=dataset.truncated[steps],
                success=labels.success[steps],
                extras={name: dataset.arrays[f"extras/{name}"][steps] for name in extras},
                seed=int(dataset.seeds[e]),
                source=None if dataset.source is None else dataset.sources[dataset.source[e]],
            )
