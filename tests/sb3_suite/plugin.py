"""Pytest plugin: puts an algorithm in the place of SAC before the tests are collected, and keeps the tests that take it."""

import os
import sys
from pathlib import Path

import pytest
import stable_baselines3

sys.path.insert(0, str(Path(__file__).parent))
from adapter import in_place_of_sac
from exclusions import reason

from sb3_offline import ALGOS

NAME = os.environ["SB3_SUITE_ALGORITHM"]
TESTED = in_place_of_sac(ALGOS[NAME])
stable_baselines3.SAC = TESTED


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the cases that are parametrized with the algorithm, and the tests that construct SAC by name."""
    taken, others = [], []
    for item in items:
        (taken if takes_sac(item) else others).append(item)
    for item in taken:
        why = reason(NAME, item.nodeid)
        if why:
            item.add_marker(pytest.mark.skip(reason=why))
    config.hook.pytest_deselected(items=others)
    items[:] = taken


def takes_sac(item: pytest.Item) -> bool:
    """:return: whether a test constructs the algorithm"""
    parameters = getattr(item, "callspec", None)
    values = list(parameters.params.values()) if parameters else []
    classes = [value for value in values if isinstance(value, type) and hasattr(value, "learn")]
    if classes:
        return TESTED in classes
    if "sac" in values:
        return True
    code = item.function.__code__  # type: ignore[attr-defined]
    return "SAC" in code.co_names and not any(name in code.co_names for name in ("PPO", "A2C"))
