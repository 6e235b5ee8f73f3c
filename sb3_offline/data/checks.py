"""Checks of values that make data unusable, in whatever format they were stored."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_offline.data.arrays import ArrayLike
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.format import Header
from sb3_offline.data.spaces import check_choices, check_range, subspaces

CHECK_BYTES = 1 << 24
BOTH_ENDS = ("is true in a step that also terminates", "An episode has one end: where it terminates, it is not truncated")
"""Problem and remedy where an episode both terminates and is truncated."""


def check_values(header: Header, arrays: Mapping[str, Any], path: Path) -> None:
    """
    Check all values that can be wrong. Images of integers are not read: all of their values are valid, and they are large.

    :param header: of the dataset
    :param arrays: by name, as ``Header.fields`` names them
    :param path: file for error messages
    :raises DatasetError: if a float is not finite, if a choice or an image is not in its space, if an
        episode goes on after its end or has two ends, or if the label of a source is unknown
    """
    plain = subspaces(header.observation_space, "observations")
    for name, space in {"actions": header.action_space, "rewards": None, **plain}.items():
        if name in arrays:
            _check_array(name, arrays[name], space if name == "actions" or name in plain else None, path)
    lengths = arrays["episodes/length"]
    inside = np.ones(int(lengths.sum()), dtype=bool)
    inside[np.cumsum(lengths) - 1] = False
    for name in ("terminated", "truncated"):
        if arrays[name][inside].any():
            row = int(np.argmax(arrays[name] & inside))
            remedy = "Split the episode there: it ends with the step that terminates or truncates it"
            raise DatasetError(path, name, f"is true before the last step of an episode (row {row})", remedy)
    both = arrays["terminated"] & arrays["truncated"]
    if both.any():
        problem, remedy = BOTH_ENDS
        raise DatasetError(path, "truncated", f"{problem} (row {int(np.argmax(both))})", remedy)
    indices = arrays.get("episodes/source")
    if indices is not None and len(indices) and not 0 <= indices.min() <= indices.max() < len(header.sources or ()):
        problem = f"has indices up to {indices.max()}, but there are {len(header.sources or ())} labels"
        raise DatasetError(path, "episodes/source", problem, "Write the file again with all labels")


def _check_array(name: str, array: ArrayLike, space: spaces.Space | None, path: Path) -> None:
    """Check an array as ``DatasetWriter`` checks it: floats are finite, images of floats in their range, and choices exist."""
    is_choice = isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary)
    is_image = isinstance(space, spaces.Box) and len(space.shape) == 3 and name != "actions"
    if array.dtype.kind != "f" and not is_choice:
        return
    rows = max(CHECK_BYTES // max(array.dtype.itemsize * int(np.prod(array.shape[1:])), 1), 1)
    for first in range(0, len(array), rows):  # in pieces, since an array in compressed storage is read for this
        piece = array[first : first + rows]
        if is_choice:
            check_choices(piece, space, path, name, first)  # type: ignore[arg-type]
            continue
        finite = np.isfinite(piece)
        if not finite.all():
            row = first + int(np.argmin(finite.reshape(len(finite), -1).all(axis=1)))
            remedy = "Leave that episode out when writing the file"
            raise DatasetError(path, name, f"holds NaN or infinity, first in row {row}", remedy)
        if is_image and piece.size:
            check_range(piece, space.low.min(), space.high.max(), path, name)  # type: ignore[union-attr]
