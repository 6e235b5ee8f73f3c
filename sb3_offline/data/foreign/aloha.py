"""ALOHA and ACT: a folder of HDF5 files, one for each episode."""

import io
from pathlib import Path

import h5py
import numpy as np

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import open_hdf5
from sb3_offline.data.foreign.base import Foreign, Format, Options
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.foreign.recorded import (
    HDF5_SUFFIXES,
    Episode,
    any_file,
    chosen,
    files_in,
    flattened,
    join_episodes,
    member,
    plain_attributes,
    readable,
)

NAME = "ALOHA"
# All other arrays of a file become extras.
READ = ("action", "observations", "reward", "rewards")


def recognizes(probe: Probe) -> bool:
    """
    :param probe: a path or an object
    :return: whether it is an HDF5 file with ``action`` and the group ``observations``, or a folder of such files
    """
    if probe.kind == "folder":
        return any_file(files_in(probe.path, HDF5_SUFFIXES), recognizes)
    if probe.hdf5 is None or not {"action", "observations"} <= probe.names:
        return False
    return isinstance(probe.hdf5["observations"], h5py.Group)


def read(probe: Probe, options: Options) -> Foreign:
    """
    Read episodes into memory.

    Observations become a Dict: ``qpos``, ``qvel``, ``effort`` and an image for each camera, ``images_<camera>``. Compressed
    images are decoded as by OpenCV's ``imdecode``. The files do not hold the observation after the last step, so that an
    episode loses this step. They say nothing about terminations, so that an episode ends with neither flag; one of
    ``max_episode_steps`` rows was truncated.

    :param probe: the folder, or the file of one episode
    :param options: ``observation_space`` (default: a Dict of all observations; a Dict with some of the keys reads these
        alone), ``action_space`` (default: [-1, 1], but actions of these robots are mostly joint angles, which need it) and
        ``max_episode_steps``
    :return: the data
    """
    path = probe.path
    files = files_in(path, HDF5_SUFFIXES) if probe.kind == "folder" else [path]
    probe.close()  # HDF5 may refuse to open the file a second time
    episodes = [_episode(file, options) for file in files]
    with open_hdf5(files[0]) as first:
        attributes = plain_attributes(first)
    return join_episodes(episodes, path, options, NAME, provenance={NAME: {**attributes, "files": [f.name for f in files]}})


def _episode(path: Path, options: Options) -> Episode:
    with readable(path), open_hdf5(path) as file:
        actions = member(file, "action", path)[()]
        observations = file.get("observations")
        if not isinstance(observations, h5py.Group) or not (found := flattened(observations)):
            raise DatasetError(path, "observations", "is missing", "Remove the file, or record the episode again")
        found = chosen(found, options.observation_space, path, "observations")
        rows = {key: _images(array, path) if "/images/" in array.name else array[()] for key, array in found.items()}
        extras: dict[str, np.ndarray] = {}
        for name, node in file.items():
            if name not in READ:
                arrays = flattened(node, ".", f"{name}.") if isinstance(node, h5py.Group) else {name: node}
                extras |= {key: array[()] for key, array in arrays.items() if array.ndim and len(array) == len(actions)}
        steps = {"actions": actions}
        for name in ("reward", "rewards"):
            if name in file:
                steps["rewards"] = member(file, name, path)[()].reshape(-1)
    return Episode(path, "", rows, steps, extras, truncated=len(actions) == options.max_episode_steps)


def _images(array: h5py.Dataset, path: Path) -> np.ndarray:
    """:return: (n, ...) uint8, decoded if a row holds the bytes of one compressed image, padded with zeros"""
    if array.ndim != 2:
        return array[()]
    from PIL import Image

    images = []
    for row in array:
        try:
            with Image.open(io.BytesIO(np.asarray(row, np.uint8).tobytes())) as image:
                # OpenCV stores and reads the last channel first
                images.append(np.asarray(image.convert("RGB"))[..., ::-1])
        except OSError as error:
            problem = f"holds no image in row {len(images)} ({error})"
            raise DatasetError(path, array.name.strip("/"), problem, "Remove the file, or record the episode again") from error
    return np.stack(images)


FORMAT = Format(
    name=NAME,
    description="a folder of HDF5 files, or one of these, with action and the group observations",
    recognizes=recognizes,
    read=read,
    declares_spaces=False,
)
