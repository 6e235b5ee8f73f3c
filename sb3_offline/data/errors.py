"""The error that bad data raise."""

import os
import pickle
import struct
import zipfile
import zlib


def printable(text: str) -> str:
    """
    :param text: a text with words of a file
    :return: the text for a terminal, which control characters could steer; ends of lines stay
    """
    return "".join(letter if letter.isprintable() or letter == "\n" else f"\\x{ord(letter):02x}" for letter in text)


#: What HDF5, zip archives, NumPy and JSON raise when they read damaged bytes
DAMAGE_ERRORS = (
    *(OSError, RuntimeError, KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, MemoryError),
    *(EOFError, AssertionError, zipfile.BadZipFile, zlib.error, struct.error, pickle.UnpicklingError),
)


class DatasetError(RuntimeError):
    """
    Data in a file, or data that are to be written to a file, cannot be used.

    This is a ``RuntimeError`` on purpose: Optuna (through rl_zoo3) counts ``ValueError`` and ``AssertionError`` as pruned
    trials, and SB3 turns a ``ValueError`` in ``set_parameters`` into a ``KeyError``. Both would hide bad data.

    :param file: the file at fault ("" if the data were never in a file)
    :param field: the array or attribute at fault
    :param problem: the problem with the field
    :param remedy: the action that the user can take
    """

    def __init__(self, file: str | os.PathLike, field: str, problem: str, remedy: str):
        self.file, self.field, self.problem, self.remedy = os.fspath(file), field, problem, remedy
        super().__init__(file, field, problem, remedy)  # exactly these four, so that the error can be pickled

    def __str__(self) -> str:
        place = f"{self.file}: {self.field}" if self.file else self.field
        return printable(" ".join(f"{place}: {self.problem}. {self.remedy}.".splitlines()))


def damaged_file(path: str | os.PathLike, error: BaseException, field: str = "file") -> DatasetError:
    """
    :param path: a file
    :param error: the error of a library that read it
    :param field: the array or attribute that was read
    :return: the error for the user
    """
    problem = f"cannot be read ({' '.join(str(error).split())})"
    return DatasetError(path, field, problem, "The file is damaged: take a copy, or write it again")
