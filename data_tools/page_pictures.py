"""Which frames of a dataset its page shows."""

from typing import NamedTuple

import numpy as np
from gymnasium import spaces
from PIL import Image

from sb3_offline.data.spaces import subspaces
from sb3_offline.data_tools.joined_datasets import JoinedDatasets

FRAMES = 8
"""Moments shown of an episode."""
LARGEST = 128
"""Larger frames are made smaller (pixels)."""
MOST_SOURCES = 8


class FilmStrip(NamedTuple):
    """
    :param episode: its number
    :param source: its label, or ""
    :param solved: whether it succeeded at any step; ``None`` without labels
    :param moments: (n,) numbers of its observations
    :param success: (n,) bool, whether the step that led there was a success
    :param frames: n pictures, (height, width, 3) uint8 each
    """

    episode: int
    source: str
    solved: bool | None
    moments: np.ndarray
    success: np.ndarray
    frames: list[np.ndarray]


def image_name(data: JoinedDatasets) -> str | None:
    """:return: name of the first array of images among the observations"""
    plain = subspaces(data.observation_space, "observations")
    return next((name for name, space in plain.items() if len(space.shape or ()) == 3), None)


def film_strips(data: JoinedDatasets, seed: int = 0) -> list[FilmStrip]:
    """
    Draw episodes at random, of each source a success and a failure (two where there are few sources).

    :param data: with one episode at least
    :param seed: of the draw
    :return: raises ``RuntimeError`` or ``ModuleNotFoundError`` where there are no frames and none can be drawn
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
            numbers = np.flatnonzero(inside if solved is None else inside & (solved == outcome))
            for episode in np.sort(rng.permutation(numbers)[:each]):
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
        frames = [to_picture(image, space) for image in data.arrays[name][data.observation_starts[episode] + moments]]
    else:
        from sb3_offline.data_tools.render_dataset import draw_moments

        frames = list(draw_moments(*data.locate(episode), moments))
    return FilmStrip(episode, label, solved, moments, success, frames)


def to_picture(image: np.ndarray, space: spaces.Space) -> np.ndarray:
    """
    :param image: an image of a space, in either layout; of several channels the last three (or the last) are shown
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
    picture = np.broadcast_to(image, (*image.shape[:2], 3))
    if max(picture.shape[:2]) <= LARGEST:
        return np.ascontiguousarray(picture)
    small = Image.fromarray(np.ascontiguousarray(picture))
    small.thumbnail((LARGEST, LARGEST), Image.Resampling.BOX)
    return np.asarray(small)
