"""The one error that bad data raises."""

import os


class DatasetError(RuntimeError):
    """
    A data file, or data on its way into one, cannot be used.

    A ``RuntimeError`` on purpose: Optuna (through rl_zoo3) counts ``ValueError`` and ``AssertionError`` as pruned
    trials, and SB3 turns a ``ValueError`` in ``set_parameters`` into a ``KeyError``. Both would hide bad data.

    :param file: the file at fault ("" when the data never was in a file)
    :param field: the array or attribute at fault
    :param problem: what is wrong with it
    :param remedy: what the user can do about it
    """

    def __init__(self, file: str | os.PathLike, field: str, problem: str, remedy: str):
        self.file, self.field, self.problem, self.remedy = os.fspath(file), field, problem, remedy
        super().__init__(file, field, problem, remedy)  # these four, so that it pickles across processes

    def __str__(self) -> str:
        place = f"{self.file}: {self.field}" if self.file else self.field
        return f"{place}: {self.problem}. {self.remedy}."
