"""Conversion of datasets: to contiguous storage (for training), to compressed storage (for keeping and sending), to Minari."""

import contextlib
import os
from pathlib import Path

import h5py
import numpy as np
from tqdm.auto import tqdm

from sb3_offline.data.checksums import RunningChecksums, counts_of, damage
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import WriteLock, check_outputs, replacing
from sb3_offline.data.foreign.registry import format_of_name, write_foreign
from sb3_offline.data.format import CHECKSUMS, CHUNK_BYTES, Storage, checksum_columns, create_file
from sb3_offline.data.reader import OfflineDataset

PIECE_BYTES = 1 << 25


def convert(
    dataset: str | os.PathLike | OfflineDataset,
    destination: str | os.PathLike,
    storage: Storage = "contiguous",
    *,
    overwrite: bool = False,
    progress_bar: bool = True,
) -> None:
    """
    Copy a dataset to another storage or format. All values and attributes stay the same. The destination is written completely
    or not at all.

    :param dataset: anything that :class:`~sb3_offline.data.reader.OfflineDataset` opens
    :param destination: file to write; or a name such as "minari:namespace/name-v0" for a new Minari dataset. A dataset of our
        own format may be converted in its place, if ``overwrite`` is true
    :param storage: "contiguous" or "compressed" (gzip), for a file
    :param overwrite: replace an existing file
    :param progress_bar: show the progress
    :raises DatasetError: if the dataset cannot be opened, if its episodes do not match their checksums, if the destination
        exists and ``overwrite`` is false, if it is a file of a dataset of another library, or if another process writes it
    """
    opened = dataset if isinstance(dataset, OfflineDataset) else OfflineDataset(dataset)
    foreign = format_of_name(os.fspath(destination))
    if foreign is not None:
        write_foreign(foreign, opened.header, opened.arrays, os.fspath(destination))
        return
    path = Path(destination).expanduser()
    # Other writers of the destination are refused at once instead of doing all the work for nothing
    with WriteLock(path) as lock, contextlib.ExitStack() as stack:
        if path.exists() and not overwrite:
            raise DatasetError(path, "file", "exists already", "Give another name, or overwrite it (--overwrite)")
        if opened.storage != "memory" and path.exists() and os.path.samefile(path, opened.path):
            # A writer may have added episodes before this process got the lock; a copy without them would lose them
            latest = OfflineDataset(opened.path)
            if isinstance(dataset, OfflineDataset) and not _same_episodes(opened, latest):
                remedy = "Convert it again"
                raise DatasetError(path, "file", "was written to by another process after it was opened", remedy)
            opened = opened if isinstance(dataset, OfflineDataset) else latest
        fields = opened.header.fields()
        total = sum(spec.rows(opened.n_episodes, opened.n_steps) * spec.row_bytes for spec in fields.values())
        if opened.storage == "memory":
            check_outputs([path], [opened.path])
        temporary = stack.enter_context(replacing(path, lock))
        bar = stack.enter_context(tqdm(total=total, unit="B", unit_scale=True, disable=not progress_bar))
        bar.set_description(f"{opened.path.name} -> {storage}")
        create_file(temporary, opened.header, opened.n_episodes, opened.n_steps, committed=opened.n_episodes, storage=storage)
        with h5py.File(temporary, "r+", locking=False) as file:
            checksums = np.zeros((opened.n_episodes, len(fields)), np.uint32)
            for column, name in enumerate(checksum_columns(fields)):
                array, spec = opened.arrays[name], fields[name]
                running = RunningChecksums(counts_of(name, opened.lengths))
                # Whole chunks at a time, so that none is compressed twice
                chunk = max(CHUNK_BYTES // max(spec.row_bytes, 1), 1)
                rows = max(PIECE_BYTES // max(spec.row_bytes, 1) // chunk, 1) * chunk
                for first in range(0, len(array), rows):
                    last = min(first + rows, len(array))
                    piece = np.asarray(array[first:last], spec.dtype)
                    file[name][first:last] = piece
                    running.update(piece)
                    bar.update((last - first) * spec.row_bytes)
                checksums[:, column] = running.values
                if opened.checksums is not None and (wrong := running.values != opened.checksums.of(name)).any():
                    raise damage(opened.path, name, np.flatnonzero(wrong).tolist())
            if opened.n_episodes:
                file[CHECKSUMS][:] = checksums


def _same_episodes(one: OfflineDataset, other: OfflineDataset) -> bool:
    if (one.checksums is None) != (other.checksums is None) or not np.array_equal(one.lengths, other.lengths):
        return False
    return one.checksums is None or other.checksums is None or np.array_equal(one.checksums.values, other.checksums.values)
