"""The value range of each array of a dataset. Arrays are read piece by piece; images are sampled."""

from typing import Any, NamedTuple

import numpy as np

from sb3_offline.data.storage import RowStore
from sb3_offline.data_tools.inspecting.joined_datasets import JoinedDatasets

SAMPLED_IMAGES = 256
PIECE_BYTES = 1 << 25


class ArrayStatistics(NamedTuple):
    """
    :param array: the array that was read
    :param low: (columns,) smallest finite value of each column; (1,) for images
    :param high: (columns,) largest finite value of each column; (1,) for images
    :param n_bad: number of rows read that hold NaN or infinity
    :param images: (n, values) the sampled images, flattened; ``None`` if the array holds no images
    """

    array: RowStore
    low: np.ndarray
    high: np.ndarray
    n_bad: int
    images: np.ndarray | None = None

    def summary(self) -> dict[str, Any]:
        """:return: shape, dtype, smallest and largest value, as JSON types"""
        known = {"min": float(self.low.min()), "max": float(self.high.max())} if np.isfinite(self.low).any() else {}
        return {"shape": list(self.array.shape), "dtype": str(self.array.dtype), **known}


def array_statistics(data: JoinedDatasets) -> dict[str, ArrayStatistics]:
    """
    :param data: the dataset
    :return: the statistics of each array, by name
    """
    return {name: _of_images(array) if len(array.shape) == 4 else _of_rows(array) for name, array in data.arrays.items()}


def _of_images(array: RowStore) -> ArrayStatistics:
    rows = np.unique(np.linspace(0, len(array) - 1, SAMPLED_IMAGES).astype(int)) if len(array) else np.zeros(0, int)
    images = array[rows].reshape(len(rows), int(np.prod(array.shape[1:])))
    finite = np.isfinite(images).all(axis=1)
    kept = images[finite]
    low, high = (kept.min(), kept.max()) if len(kept) else (np.inf, -np.inf)
    return ArrayStatistics(array, np.array([low]), np.array([high]), int((~finite).sum()), images)


def _of_rows(array: RowStore) -> ArrayStatistics:
    columns = int(np.prod(array.shape[1:]))
    if array.dtype.kind not in "biuf":  # text
        return ArrayStatistics(array, np.full(1, np.inf), np.full(1, -np.inf), 0)
    low, high, n_bad = np.full(columns, np.inf), np.full(columns, -np.inf), 0
    rows = max(PIECE_BYTES // max(columns * array.dtype.itemsize, 1), 1)
    for first in range(0, len(array), rows):
        piece = array[first : first + rows].reshape(-1, columns)
        finite = np.isfinite(piece).all(axis=1)
        n_bad += int((~finite).sum())
        if finite.any():
            kept = piece[finite]
            low, high = np.minimum(low, kept.min(axis=0)), np.maximum(high, kept.max(axis=0))
    return ArrayStatistics(array, low, high, n_bad)
