"""Whole files checked: every array of a dataset against its checksums, and files of success examples."""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_offline.data.checks import check_values
from sb3_offline.data.checksums import array_checksums, counts_of, damage, mismatches, ranges
from sb3_offline.data.convert import convert
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import EXAMPLES_FORMAT, load_examples
from sb3_offline.data.files import check_outputs, open_hdf5
from sb3_offline.data.format import CHECKSUMS
from sb3_offline.data.native import is_native, read_native
from sb3_offline.data.plain import is_text, read_attribute
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.spaces import space_from_json


class Verdict(NamedTuple):
    """
    What a check found.

    :param path: the file or folder
    :param contents: its contents in words
    :param damages: what is damaged, one line each; empty if nothing is
    :param notes: what the user should know although nothing is damaged
    """

    path: str
    contents: str
    damages: list[str]
    notes: list[str]

    def lines(self) -> list[str]:
        """:return: the verdict in words"""
        if self.damages:
            return [f"damaged: {text}" for text in self.damages]
        return [f"ok: {self.path}: {self.contents}", *(f"note: {self.path}: {text}" for text in self.notes)]


def check_dataset(path: str | os.PathLike, *, trust: bool = False) -> Verdict:
    """
    Check a dataset as a whole. The arrays of a file of our own format are compared with the checksums of its episodes.

    :param path: anything that :class:`~sb3_offline.data.reader.OfflineDataset` opens by name
    :param trust: open pickles that may run any code
    :return: the verdict; all damage that can be found is in it
    """
    try:
        if is_dataset_file(path):
            intact, damages, note = intact_episodes(path)
            if damages:
                return Verdict(os.fspath(path), "dataset", [_line(error, path, intact, note) for error in damages], [])
        dataset = OfflineDataset(path, trust=trust)
        if dataset.checksums is None and dataset.storage != "memory":
            for name in dataset.arrays:
                array_checksums(dataset.arrays[name], counts_of(name, dataset.lengths))  # reads every byte
    except DatasetError as error:
        return Verdict(os.fspath(path), "dataset", [str(error)], [])
    contents = f"dataset of {dataset.n_episodes} episodes and {dataset.n_steps} steps"
    if dataset.checksums is not None:
        return Verdict(os.fspath(path), f"{contents}, all of which match their checksums", [], [note] if note else [])
    missing = "it has no checksums, so a changed value would not be noticed; sb3-offline convert writes a copy with checksums"
    return Verdict(os.fspath(path), contents, [], [missing] if dataset.storage != "memory" else [])


def intact_episodes(path: str | os.PathLike) -> tuple[np.ndarray, list[DatasetError], str]:
    """
    Compare a dataset file with its checksums.

    :param path: a file of our own format
    :return: the indices of the intact episodes, the damaged arrays, and a remark on an episode that is not counted, or ""
    :raises DatasetError: if the file cannot be read, or if its values are wrong although they match
    """
    path = Path(path).expanduser().absolute()
    with open_hdf5(path) as file:
        native = read_native(file, path)
        lengths, checksums = native.arrays["episodes/length"], native.checksums
        n = len(lengths)
        uncounted = CHECKSUMS in file and n < len(file["episodes/length"]) and file["episodes/length"][n] > 0
    if checksums is None:
        check_values(native.header, native.arrays, path)
        return np.arange(n), [], ""
    found = mismatches(native.arrays, checksums, native.arrays)
    bad = set().union(*found.values())
    if "episodes/length" in found:
        bad |= set(range(found["episodes/length"][0], n))  # where they lie is unknown
    note = "the rows of one more episode follow, which was being written when its process was killed" if uncounted else ""
    return np.setdiff1d(np.arange(n), list(bad)), [damage(path, name, episodes) for name, episodes in found.items()], note


def _line(error: DatasetError, path: str | os.PathLike, intact: np.ndarray, note: str) -> str:
    if len(intact):
        which = f"{len(intact)} episodes are intact ({ranges(intact.tolist())})"
        remedy = f"{which}; to copy them: sb3-offline check {os.fspath(path)} --rescue NEW_FILE"
    else:
        remedy = "No episode is intact: restore the file from a copy"
    return str(DatasetError(error.file, error.field, error.problem, remedy))


def rescue(path: str | os.PathLike, destination: str | os.PathLike) -> tuple[int, int]:
    """
    Copy the intact episodes of a dataset file to a new file.

    :param path: a damaged file of our own format
    :param destination: the file to write, which must not exist
    :return: number of episodes that were copied, and that were left behind
    :raises DatasetError: if the file is too damaged to be read, if no episode is intact, or if the destination exists
    """
    check_outputs([destination], [path])
    intact, _, _ = intact_episodes(path)
    if not len(intact):
        raise DatasetError(path, "episodes", "are all damaged", "Restore the file from a copy")
    convert(OfflineDataset(path, episodes=intact), destination, progress_bar=False)
    with open_hdf5(path) as file:
        return len(intact), int(file["n_episodes"][()]) - len(intact)


def check_examples(path: str | os.PathLike) -> Verdict:
    """
    Check a file of success examples.

    :param path: a file of :func:`~sb3_offline.data.examples.save_examples`
    :return: the verdict
    """
    try:
        with open_hdf5(path) as file:
            text = read_attribute(file, "observation_space")
        try:
            space = space_from_json(text)
        except Exception as error:  # spaces check their arguments in several ways
            problem = f"cannot be understood ({error})"
            raise DatasetError(
                path, "attribute observation_space", problem, "Write the file again with save_examples"
            ) from error
        examples = load_examples(path, space)
    except DatasetError as error:
        return Verdict(os.fspath(path), "success examples", [str(error)], [])
    n = len(next(iter(examples.values())) if isinstance(examples, dict) else examples)
    return Verdict(os.fspath(path), f"{n} success examples", [], [])


def is_examples_file(path: str | os.PathLike) -> bool:
    """
    :param path: an HDF5 file
    :return: whether it says that it holds success examples
    """
    with open_hdf5(path) as file:
        return is_text(read_attribute(file, "format"), EXAMPLES_FORMAT)


def is_dataset_file(path: str | os.PathLike) -> bool:
    """
    :param path: a file, a folder, or a name of a dataset
    :return: whether it is a file that says that it is of our own format
    """
    place = Path(path).expanduser()
    if not place.is_file():
        return False
    with place.open("rb") as file:
        if file.read(8) != b"\x89HDF\r\n\x1a\n":
            return False
    with open_hdf5(place) as opened:
        return is_native(opened)
