"""Datasets from one form to another: contiguous (for training), compressed (for keeping and sending), and other libraries'."""

import os
from pathlib import Path

import h5py
from tqdm.auto import tqdm

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import replacing
from sb3_offline.data.format import CHUNK_BYTES, Storage, create_file
from sb3_offline.data.minari import PREFIX, write_minari
from sb3_offline.data.reader import OfflineDataset

PIECE_BYTES = 1 << 25


def convert(
    source: str | os.PathLike | OfflineDataset,
    destination: str | os.PathLike,
    storage: Storage = "contiguous",
    *,
    overwrite: bool = False,
    progress_bar: bool = True,
) -> None:
    """
    Copy a dataset to another form; every value and attribute stays the same. The destination appears whole or not at
    all.

    :param source: whatever :class:`~sb3_offline.data.reader.OfflineDataset` opens
    :param destination: file to write, which may be the source itself with ``overwrite``; or ``minari:namespace/name-v0``, a
        new Minari dataset
    :param storage: "contiguous" or "compressed" (gzip), of a file
    :param overwrite: replace an existing file
    :param progress_bar: show progress
    """
    dataset = source if isinstance(source, OfflineDataset) else OfflineDataset(source)
    if os.fspath(destination).startswith(PREFIX):
        write_minari(dataset, os.fspath(destination))
        return
    path = Path(destination)
    if path.exists() and not overwrite:
        raise DatasetError(path, "file", "exists already", "Give another name, or overwrite it (--overwrite)")
    fields = dataset.header.fields()
    total = sum(spec.rows(dataset.n_episodes, dataset.n_steps) * spec.row_bytes for spec in fields.values())
    with replacing(path) as temporary, tqdm(total=total, unit="B", unit_scale=True, disable=not progress_bar) as bar:
        bar.set_description(f"{dataset.path.name} -> {storage}")
        create_file(
            temporary, dataset.header, dataset.n_episodes, dataset.n_steps, committed=dataset.n_episodes, storage=storage
        )
        with h5py.File(temporary, "r+", locking=False) as file:
            for name, spec in fields.items():
                array = dataset.arrays[name]
                # Whole chunks at a time, so that none is compressed twice
                chunk = max(CHUNK_BYTES // max(spec.row_bytes, 1), 1)
                rows = max(PIECE_BYTES // max(spec.row_bytes, 1) // chunk, 1) * chunk
                for first in range(0, len(array), rows):
                    last = min(first + rows, len(array))
                    file[name][first:last] = array[first:last]
                    bar.update((last - first) * spec.row_bytes)
