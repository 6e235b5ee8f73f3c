"""Which of a package's names are algorithms, and what these are called in configs and on the command line."""

from collections.abc import Mapping
from typing import Any

from sb3_offline.common.offline_algorithm import OfflineAlgorithm


def algorithms_in(names: Mapping[str, Any]) -> dict[str, type[OfflineAlgorithm]]:
    """
    :param names: a module's names and what they stand for
    :return: the algorithms among them by the names of their folders, sorted
    """
    algorithms = [value for value in names.values() if isinstance(value, type) and issubclass(value, OfflineAlgorithm)]
    found = {cls.__module__.split(".")[1]: cls for cls in algorithms if cls is not OfflineAlgorithm}
    return dict(sorted(found.items()))
