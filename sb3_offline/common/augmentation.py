"""Random shifts of images."""

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import PyTorchObs

# Number of images that share one offset. Slicing a group takes much less time than gathering each image, and 8 to 24 different
# offsets in a batch are enough.
GROUP_SIZE = 32


def random_shift(images: th.Tensor, max_shift: int, rng: np.random.Generator) -> th.Tensor:
    """
    Shift images by up to ``max_shift`` pixels in each direction, and repeat their edges. Each group of ``GROUP_SIZE`` images
    is shifted alike, so a batch of 32 images has one shift.

    :param images: ``(batch, channels, height, width)``, any dtype
    :param max_shift: largest shift in pixels; 0 returns ``images`` itself
    :param rng: generator that draws the shifts
    :return: a tensor like ``images``
    """
    if max_shift == 0:
        return images
    max_shift = min(max_shift, *(size - 1 for size in images.shape[2:]))
    shifted = th.empty_like(images)
    for start in range(0, len(images), GROUP_SIZE):
        down, right = (int(offset) for offset in rng.integers(-max_shift, max_shift + 1, size=2))
        rows, columns = _overlap(images.shape[2], down), _overlap(images.shape[3], right)
        group = shifted[start : start + GROUP_SIZE]
        group[:, :, rows[0], columns[0]] = images[start : start + GROUP_SIZE, :, rows[1], columns[1]]
        _repeat_edges(group, columns[0], dim=3)
        _repeat_edges(group, rows[0], dim=2)
    return shifted


def _overlap(size: int, offset: int) -> tuple[slice, slice]:
    """:return: the lines that shifted lines are copied to, and the lines that they are copied from"""
    first, kept = max(-offset, 0), size - abs(offset)
    return slice(first, first + kept), slice(first + offset, first + offset + kept)


def _repeat_edges(images: th.Tensor, filled: slice, dim: int) -> None:
    """Fill the margins before and after ``filled`` along a dimension with its first and last line."""
    size = images.shape[dim]
    for first, count, line in ((0, filled.start, filled.start), (filled.stop, size - filled.stop, filled.stop - 1)):
        if count:
            images.narrow(dim, first, count).copy_(images.narrow(dim, line, 1))


def has_images(space: spaces.Space, float_images: bool = False) -> bool:
    """
    :param space: observation space
    :param float_images: see :func:`shift_observations`
    :return: whether observations contain images, which could be shifted
    """
    parts = space.values() if isinstance(space, spaces.Dict) else [space]
    return any(is_image_space(part, normalized_image=float_images) for part in parts)


def shift_observations(
    observations: PyTorchObs, space: spaces.Space, max_shift: int, rng: np.random.Generator, float_images: bool = False
) -> PyTorchObs:
    """
    Apply :func:`random_shift` to all images in a batch of observations. Vectors stay as they are.

    :param observations: a batch, or a dict of batches, of all keys of the space or of some
    :param space: space of one observation, images channel-first
    :param max_shift: largest shift in pixels
    :param rng: generator that draws the shifts
    :param float_images: treat arrays with three axes as normalised images, whatever their dtype
    :return: observations like the given ones
    """
    if isinstance(space, spaces.Dict):
        parts = {key: (observations[key], space[key]) for key in space if key in observations}  # type: ignore[index, operator]
        return {key: shift_observations(*part, max_shift, rng, float_images) for key, part in parts.items()}  # type: ignore
    is_image = is_image_space(space, normalized_image=float_images)
    return random_shift(observations, max_shift, rng) if is_image else observations  # type: ignore[arg-type]
