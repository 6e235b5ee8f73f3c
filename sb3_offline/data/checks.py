"""Checks of values that make data unusable, in whatever format they were stored."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sb3_offline.data.arrays import ArrayLike
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.format import Header
from sb3_offline.data.spaces import subspaces

CHECK_BYTES = 1 << 24


def check_values(header: Header, arrays: Mapping[str, Any], path: Path) -> None:
    """
    Check all values that can be wrong. Images of integers are not read: all of their values are valid, and they are large.

    :param header: of the dataset
    :param arrays: by name, as ``Header.fields`` names them
    :param path: file for error messages
    :raises DatasetError: if a float is not finite, if an episode goes on after its end, or if the label of a source is unknown
    """
    for name in ["actions", "rewards", *subspaces(header.observation_space, "observations")]:
        if name in arrays and arrays[name].dtype.kind == "f":
            _check_finite(name, arrays[name], path)
    lengths = arrays["episodes/length"]
    inside = np.ones(int(lengths.sum()), dtype=bool)
    inside[np.cumsum(lengths) - 1] = False
    for name in ("terminated", "truncated"):
        if arrays[name][inside].any():
            row = int(np.argmax(arrays[name] & inside))
            remedy = "Split the episode there: it ends with the step that terminates or truncates it"
            raise DatasetError(path, name, f"is true before the last step of an episode (row {row})", remedy)
    indices = arrays.get("episodes/source")
    if indices is not None and len(indices) and not 0 <= indices.min() <= indices.max() < len(header.sources or ()):
        problem = f"has indices up to {indices.max()}, but there are {len(header.sources or ())} labels"
        raise DatasetError(path, "episodes/source", problem, "Write the file again with all labels")


def _check_finite(name: str, array: ArrayLike, path: Path) -> None:
    rows = max(CHECK_BYTES // max(array.dtype.itemsize * int(np.prod(array.shape[1:])), 1), 1)
    for first in range(0, len(array), rows):  # in pieces, since an array in compressed storage is read for this
        finite = np.isfinite(array[first : first + rows])
        if not finite.all():
            row = first + int(np.argmin(finite.reshape(len(finite), -1).all(axis=1)))
            remedy = "Leave that episode out when writing the file"
            raise DatasetError(path, name, f"holds NaN or infinity, first in row {row}", remedy)
