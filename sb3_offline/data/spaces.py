"""Gymnasium spaces as JSON, and arrays checked against spaces."""

import json
import math
import operator
import os
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError

MAX_SIZE = 1 << 26
"""Largest number of elements of an observation or action in a file: images of 8,000 x 8,000 are smaller."""


def space_to_json(space: spaces.Space) -> str:
    """
    :param space: a Box, Discrete, MultiDiscrete or MultiBinary space, or a Dict of these
    :return: JSON text, which ``space_from_json`` turns into an equal space
    :raises DatasetError: if the space is of another kind, or if it would change
    """
    text = json.dumps(_encode(space))
    if space_from_json(text) != space:
        raise DatasetError("", "space", f"{space} cannot be stored: it would be read as another space", "Wrap the environment")
    return text


def space_from_json(text: str) -> spaces.Space:
    """
    :param text: JSON text from ``space_to_json``
    :return: the space
    :raises ValueError: (or ``KeyError``, ``TypeError``) if the text describes no space
    """
    return _decode(json.loads(text))


def _encode(space: spaces.Space) -> dict[str, Any]:
    if isinstance(space, spaces.Box):
        bounds = {"low": _encode_bound(space.low), "high": _encode_bound(space.high)}
        return {"type": "Box", "shape": list(space.shape), "dtype": str(space.dtype), **bounds}
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiDiscrete):
        start = space.start.tolist()
        return {"type": "MultiDiscrete", "nvec": space.nvec.tolist(), "start": start, "dtype": str(space.dtype)}
    if isinstance(space, spaces.MultiBinary):
        return {"type": "MultiBinary", "n": space.n if isinstance(space.n, int) else [int(n) for n in space.shape]}
    if isinstance(space, spaces.Dict) and not any(isinstance(s, spaces.Dict) or "/" in k for k, s in space.items()):
        return {"type": "Dict", "spaces": {key: _encode(subspace) for key, subspace in space.items()}}
    supported = "Box, Discrete, MultiDiscrete, MultiBinary and flat Dict spaces (no '/' in keys)"
    raise DatasetError("", "space", f"{space} cannot be stored", f"The format holds {supported}; wrap the environment")


def _decode(data: dict[str, Any]) -> spaces.Space:
    kind = data["type"]
    if kind == "Box":
        shape, dtype = tuple(operator.index(size) for size in data["shape"]), np.dtype(data["dtype"])
        if math.prod(shape) > MAX_SIZE:  # before memory is taken for the bounds
            raise ValueError(f"a space of shape {shape} is too large")
        exact = np.float64 if dtype.kind == "f" else dtype  # floats cannot represent large integers
        low, high = (np.broadcast_to(np.array(data[k], dtype=exact), shape).astype(dtype) for k in ("low", "high"))
        if not (low <= high).all():  # false for NaN, too
            raise ValueError("a lower bound is above the upper one, or is no number")
        return spaces.Box(low, high, shape, dtype.type)
    if kind == "Discrete":
        return spaces.Discrete(data["n"], start=data["start"])
    if kind == "MultiDiscrete":
        return spaces.MultiDiscrete(data["nvec"], np.dtype(data.get("dtype", "int64")).type, start=data.get("start"))
    if kind == "MultiBinary":
        return spaces.MultiBinary(data["n"])
    if kind == "Dict":
        return spaces.Dict(OrderedDict((key, _decode(value)) for key, value in data["spaces"].items()))
    raise ValueError(f"unknown space type {kind!r}")


def _encode_bound(bound: np.ndarray) -> Any:
    """:return: one number if all are equal, else nested lists. Infinities become strings, which NumPy parses: JSON has none"""
    uniform = bound.size > 0 and (bound == bound.flat[0]).all()
    values = np.asarray(bound.flat[0] if uniform else bound).astype(object)

    def encode(value: Any) -> Any:
        return str(float(value)) if np.isinf(value) else value

    return np.vectorize(encode, otypes=[object])(values).tolist() if values.size else []


def subspaces(space: spaces.Space, name: str) -> dict[str, spaces.Space]:
    """
    :param space: any space
    :param name: name of the arrays of this space, e.g. "observations"
    :return: the plain spaces by array name: ``{name: space}``, or ``{name/key: subspace}`` for a Dict space
    """
    if isinstance(space, spaces.Dict):
        return {f"{name}/{key}": subspace for key, subspace in space.items()}
    return {name: space}


def subspace(space: spaces.Space, keys: Sequence[str]) -> spaces.Dict:
    """
    :param space: a Dict space
    :param keys: some of its keys
    :return: the Dict space of these keys, in the order that they have in ``space``
    """
    assert isinstance(space, spaces.Dict)
    return spaces.Dict(OrderedDict((key, part) for key, part in space.spaces.items() if key in keys))


def same_actions(space: spaces.Space, other: spaces.Space) -> bool:
    """
    :param space: an action space
    :param other: another action space
    :return: whether they are the same, apart from the precision of floats: files hold float32 in any case
    """
    if isinstance(space, spaces.Box) and isinstance(other, spaces.Box) and space.dtype.kind == other.dtype.kind == "f":
        one, two = (np.array([box.low, box.high], np.float32) for box in (space, other))
        return np.array_equal(one, two)
    return space == other


def stack_observations(observations: Sequence[Any]) -> Any:
    """
    :param observations: single observations of a space
    :return: array of these as rows; a dict of such arrays for a Dict space
    """
    if isinstance(observations[0], Mapping):
        return {key: np.stack([observation[key] for observation in observations]) for key in observations[0]}
    return np.stack(observations)


def check_observations(
    value: Any, space: spaces.Space, rows: int | None, file: str | os.PathLike, name: str = "observations"
) -> dict[str, np.ndarray]:
    """
    Check rows of observations against their space.

    :param value: array of shape ``(rows, *space.shape)``, or a dict of such arrays for a Dict space
    :param space: the space of one observation
    :param rows: expected number of rows, ``None`` for any
    :param file: for error messages
    :param name: name of these arrays, as for ``subspaces``
    :return: arrays of the space's dtype, by their names
    :raises DatasetError: if a shape, a dtype or a value does not fit the space
    """
    parts = {name: value}
    if isinstance(space, spaces.Dict):
        if not isinstance(value, Mapping) or value.keys() != space.spaces.keys():
            problem = f"is not a dict with the keys {sorted(space.spaces)}"
            raise DatasetError(file, name, problem, "Give one array for each key of the Dict space")
        parts = {f"{name}/{key}": part for key, part in value.items()}
    checked = {}
    for field, subspace in subspaces(space, name).items():
        shape, dtype = tuple(subspace.shape or ()), np.dtype(subspace.dtype)
        checked[field] = check_rows(parts[field], shape, dtype, rows, file, field)
        # Only images: environments often exceed the bounds that they declare for other observations
        if isinstance(subspace, spaces.Box) and dtype.kind == "f" and len(shape) == 3 and checked[field].size:
            check_range(checked[field], subspace.low.min(), subspace.high.max(), file, field)
        check_choices(checked[field], subspace, file, field)
    return checked


def to_array(value: Any, file: str | os.PathLike, field: str) -> np.ndarray:
    """
    :param value: array-like
    :param file: for error messages
    :param field: for error messages
    :return: the array
    :raises DatasetError: if rows differ in shape
    """
    try:
        return np.asarray(value)
    except ValueError as error:
        raise DatasetError(file, field, f"is no array ({error})", "Give rows of one shape") from error


def check_rows(
    value: Any, shape: tuple[int, ...], dtype: np.dtype, rows: int | None, file: str | os.PathLike, field: str
) -> np.ndarray:
    """
    Check rows of one array, and convert them to a dtype. The conversion changes values by rounding at most.

    :param value: array-like of shape ``(rows, *shape)``
    :param shape: shape of one row
    :param dtype: dtype of the result
    :param rows: expected number of rows, ``None`` for any
    :param file: for error messages
    :param field: for error messages
    :return: array of shape ``(rows, *shape)``
    :raises DatasetError: if the shape is another one, if the dtype does not fit, or if a value is NaN, infinite, or outside of
        the range of the dtype
    """
    array = _shaped(value, shape, rows, file, field)
    if array.dtype.kind not in "iubf" or (array.dtype.kind == "f" and dtype.kind in "iu"):
        remedy = "Convert it first (floats in [0, 1] to uint8: (255 * x).round().astype(np.uint8))"
        raise DatasetError(file, field, f"has dtype {array.dtype}, expected {dtype}", remedy)
    if dtype.kind == "f":
        with np.errstate(over="ignore"):  # an overflow becomes an infinity, which is reported
            array = array.astype(dtype, copy=False)
        finite = np.isfinite(array)
        if not finite.all():
            row = int(np.argmin(finite.reshape(len(array), -1).all(axis=1)))
            raise DatasetError(file, field, f"holds NaN or infinity, first in row {row}", "Repair it or leave it out")
    elif array.dtype != dtype and array.size:
        if dtype.kind == "b":
            if not ((array == 0) | (array == 1)).all():
                raise DatasetError(file, field, "holds values other than 0 and 1", "Give flags of true and false")
        else:
            check_range(array, np.iinfo(dtype).min, np.iinfo(dtype).max, file, field)
    return array.astype(dtype, copy=False)


def check_extra(
    value: Any, shape: tuple[int, ...], dtype: np.dtype, rows: int | None, file: str | os.PathLike, field: str
) -> np.ndarray:
    """
    Check rows like :func:`check_rows`, with the same arguments, for arrays that no learner uses. Floats may be NaN or
    infinite, and rows may be text.
    """
    if dtype.kind not in "fS":
        return check_rows(value, shape, dtype, rows, file, field)
    array = _shaped(value, shape, rows, file, field)
    if array.dtype.kind not in ("iubf" if dtype.kind == "f" else "S"):
        remedy = "Convert it first (text: np.char.encode)"
        raise DatasetError(file, field, f"has dtype {array.dtype}, expected {dtype}", remedy)
    if dtype.kind == "S" and array.dtype.itemsize > dtype.itemsize:
        problem = f"has texts of up to {array.dtype.itemsize} bytes, but the file has room for {dtype.itemsize}"
        raise DatasetError(file, field, problem, "Shorten them, or declare a longer dtype when creating the file")
    return array.astype(dtype, copy=False)


def _shaped(value: Any, shape: tuple[int, ...], rows: int | None, file: str | os.PathLike, field: str) -> np.ndarray:
    array = to_array(value, file, field)
    if array.ndim == 0 or array.shape[1:] != shape or rows not in (None, len(array)):
        wanted = ("n" if rows is None else rows, *shape)
        problem = f"has shape {array.shape}, expected ({', '.join(map(str, wanted))}{',' if not shape else ''})"
        raise DatasetError(file, field, problem, "Give rows of this shape (and T + 1 rows of observations for T actions)")
    return array


def check_range(array: np.ndarray, low: Any, high: Any, file: str | os.PathLike, field: str) -> None:
    smallest, largest = array.min(), array.max()
    if smallest < low or largest > high:
        problem = f"holds values in [{smallest}, {largest}], outside of the range [{low}, {high}]"
        raise DatasetError(file, field, problem, "Rescale the values to the space, or declare the space that they have")


def check_choices(array: np.ndarray, space: spaces.Space, file: str | os.PathLike, field: str, first_row: int = 0) -> None:
    """
    Check that rows are choices of a space that numbers its choices.

    :param array: ``(n, *space.shape)``
    :param space: the space; any but Discrete, MultiDiscrete and MultiBinary has no such choices, and nothing is checked then
    :param file: for error messages
    :param field: for error messages
    :param first_row: index of the first of these rows, for error messages
    :raises DatasetError: if a row is not in the space
    """
    if isinstance(space, spaces.MultiBinary):
        outside = (array < 0) | (array > 1)
    elif isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        n_choices = space.n if isinstance(space, spaces.Discrete) else space.nvec
        outside = (array < space.start) | (array >= space.start + n_choices)
    else:
        return
    if outside.any():
        row = int(np.argmax(outside.reshape(len(array), -1).any(axis=1)))
        problem = f"holds {array[row]} in row {first_row + row}, which is not in {space}"
        raise DatasetError(file, field, problem, "Repair the values, or declare the space that they have")
