"""Ranges of hyperparameters for a search. A trial is anything with the methods of Optuna's trials."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Uniform:
    """
    Real numbers.

    :param low: lower bound
    :param high: upper bound
    :param log: whether the logarithm is uniform
    """

    low: float
    high: float
    log: bool = False

    def suggest(self, trial: Any, name: str) -> Any:
        """:return: the trial's suggestion for the hyperparameter ``name``"""
        return trial.suggest_float(name, self.low, self.high, log=self.log)


@dataclass(frozen=True)
class UniformInt:
    """
    Integers.

    :param low: lower bound
    :param high: upper bound, which is included
    """

    low: int
    high: int

    def suggest(self, trial: Any, name: str) -> Any:
        """:return: the trial's suggestion for the hyperparameter ``name``"""
        return trial.suggest_int(name, self.low, self.high)


class Choice:
    """
    One of several values.

    :param values: the values
    """

    def __init__(self, *values: str | int | float | None):
        self.values = values

    def suggest(self, trial: Any, name: str) -> Any:
        """:return: the trial's suggestion for the hyperparameter ``name``"""
        return trial.suggest_categorical(name, self.values)


def log_uniform(low: float, high: float) -> Uniform:
    """:return: real numbers whose logarithm is uniform"""
    return Uniform(low, high, log=True)


#: By hyperparameter. The RL Zoo's names: ``batch_size_pow`` is the power of 2, ``net_arch`` the name of a size.
SearchSpace = dict[str, Uniform | UniformInt | Choice]

LEARNING: SearchSpace = {
    "learning_rate": log_uniform(1e-5, 2e-3),
    "batch_size_pow": UniformInt(5, 10),
    "net_arch": Choice("small", "medium", "big"),
}
BOOTSTRAPPING: SearchSpace = {
    **LEARNING,
    "one_minus_gamma": log_uniform(1e-3, 0.1),
    "tau": log_uniform(1e-3, 0.08),
    "n_steps": Choice(1, 3, 10),
}
