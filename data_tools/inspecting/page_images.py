"""The frames that the page of a dataset shows."""

from typing import NamedTuple

import numpy as np
from gymnasium import spaces
from PIL import Image

from sb3_offline.data.spaces import subspaces
from sb3_offline.data_tools.converting.render_dataset import draw_moments
from sb3_offline.data_tools.inspecting.joined_datasets import JoinedDatasets

FRAMES = 8
"""Number of frames shown of an episode."""
LARGEST = 128
"""Largest width and height in pixels. Larger frames are scaled down."""
MOST_SOURCES = 8
"""Number of sources of which episodes are shown."""


class FilmStrip(NamedTuple):
    """
    Some frames of one episode.

    :param episode: index of the episode
    :param source: label of its source, or ""
    :param solved: success at any step; ``None`` without labels
    :param moments: (n,) indices of the shown observations in the episode
    :param success: (n,) bool, success of the step before each observation
    :param frames: n images, (height, width, 3) uint8 each
    """

    episode: int
    source: str
    solved: bool | None
    moments: np.ndarray
    success: np.ndarray
    frames: list[np.ndarray]


def image_name(data: JoinedDatasets) -> str | None:
    """
    :param data: the dataset
    :return: name of the first array of images among the observations, or ``None``
    """
    plain = subspaces(data.observation_space, "observations")
    return next((name for name, space in plain.items() if len(space.shape or ()) == 3), None)


def film_strips(data: JoinedDatasets, seed: int = 0) -> list[FilmStrip]:
    """
    Draw episodes at random: of each source a success and a failure, or two of each if there are few sources.

    :param data: a dataset of at least one episode
    :param seed: seed of the draw
    :return: frames of these episodes; raises ``RuntimeError`` or ``ModuleNotFoundError`` if the data hold no images and none
        can be rendered
    """
    rng = np.random.default_rng(seed)
    solved = data.solved()
    groups = data.groups()
    everything = groups.pop("all")
    chosen = groups or {"": everything}
    each = 1 if len(chosen) > 2 else 2
    strips = []
    for label, inside in list(chosen.items())[:MOST_SOURCES]:
        for outcome in (None,) if solved is None else (True, False):
            indices = np.flatnonzero(inside if solved is None else inside & (solved == outcome))
            for episode in np.sort(rng.permutation(indices)[:each]):
                strips.append(_film_strip(data, int(episode), label, outcome))
    return strips


def _film_strip(data: JoinedDatasets, episode: int, label: str, solved: bool | None) -> FilmStrip:
    moments = np.unique(np.linspace(0, data.lengths[episode], FRAMES).round().astype(int))
    success = np.zeros(len(moments), dtype=bool)
    if data.success is not None:
        success[1:] = data.success[data.step_starts[episode] + moments[1:] - 1]
    name = image_name(data)
    if name is not None:
        space = subspaces(data.observation_space, "observations")[name]
        frames = [to_image(image, space) for image in data.arrays[name][data.observation_starts[episode] + moments]]
    else:
        frames = list(draw_moments(*data.locate(episode), moments))
    return FilmStrip(episode, label, solved, moments, success, frames)


def to_image(image: np.ndarray, space: spaces.Space) -> np.ndarray:
    """
    :param image: an image of `space`, in either layout. Of a stack, the last three channels (or the last one) are shown.
    :param space: a Box
    :return: (height, width, 3) uint8
    """
    if image.shape[0] < image.shape[-1]:
        image = image.transpose(1, 2, 0)
    image = image[..., -3:] if image.shape[-1] % 3 == 0 else image[..., -1:]
    if image.dtype != np.uint8:
        bounded = isinstance(space, spaces.Box) and space.is_bounded()
        low, high = (space.low.min(), space.high.max()) if bounded else (image.min(), image.max())  # type: ignore[attr-defined]
        image = np.round(255 * np.clip((image - low) / max(high - low, 1e-9), 0, 1)).astype(np.uint8)
    coloured = np.ascontiguousarray(np.broadcast_to(image, (*image.shape[:2], 3)))
    if max(coloured.shape[:2]) <= LARGEST:
        return coloured
    small = Image.fromarray(coloured)
    small.thumbnail((LARGEST, LARGEST), Image.Resampling.BOX)
    return np.asarray(small)
