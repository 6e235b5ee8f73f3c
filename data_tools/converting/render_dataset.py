"""Draw the frames of a dataset again, from the scene states in it."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from tqdm.auto import tqdm

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import open_hdf5
from sb3_offline.data.format import read_header
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.spaces import stack_observations
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.envs import ENV_ID
from sb3_offline.parallel.processes import map_in_order

if TYPE_CHECKING:
    from sb3_offline.envs.multimodal_metaworld.scene import TableScene

STATE = "extras/scene_state"
HASHED_ROWS = 1 << 16
# Recorded in the files. It stays when this module moves, because a file is continued only if its whole record is the same.
PROGRAM = "sb3_offline.data_tools.render_dataset"


def render_dataset(
    source: str | os.PathLike[str] | OfflineDataset,
    destination: str | os.PathLike[str],
    *,
    obs_type: str = "pixels",
    frame_size: int = 64,
    camera: Mapping[str, Any] | None = None,
    n_workers: int = 2,
    overwrite: bool = False,
    progress: bool = True,
) -> int:
    """
    Write a dataset whose observations are frames, or hold frames. Everything else is copied from the source, which may hold
    states or frames.

    The frames are the ones that collecting would have drawn: to the byte, on the same renderer, if ``scene_state`` is float64.
    If it is float32, values may differ by one level. The ``env_kwargs`` of the file create the environment that observes these
    frames. After a kill, the same call continues with the first episode that is not finished.

    :param source: dataset of ``MultimodalMetaworld-v0`` with the extra ``scene_state``
    :param destination: file to write
    :param obs_type: the environment's argument of this name: "pixels" or "both"
    :param frame_size: width and height in pixels
    :param camera: the environment's argument of this name
    :param n_workers: number of processes, which does not change the file
    :param overwrite: replace another file at the destination
    :param progress: show a progress bar
    :return: number of episodes that this call drew; raises ``DatasetError`` if the source cannot be drawn or the destination
        holds something else
    """
    dataset = source if isinstance(source, OfflineDataset) else OfflineDataset(source)
    destination = Path(os.path.realpath(destination))
    if destination.exists() and os.path.samefile(dataset.path, destination):
        raise DatasetError(destination, "file", "is the source itself", "Name another file to write")
    env_kwargs: dict[str, Any] = {**dataset.env_kwargs, "obs_type": obs_type, "frame_size": frame_size}
    if camera:
        env_kwargs["camera"] = dict(camera)
    encoded = json.dumps(env_kwargs)
    check_drawable(dataset)
    env = _shared_env(encoded)
    provenance = _provenance(dataset, env)
    n_done = 0
    if destination.exists() and not overwrite:
        n_done = _episodes_done(destination, provenance)
        if n_done == dataset.n_episodes:
            return 0
    left = range(n_done, dataset.n_episodes)
    with DatasetWriter(
        destination,
        env.observation_space,
        dataset.action_space,
        env_id=dataset.env_id,
        env_kwargs=json.loads(encoded),
        provenance=provenance,
        mode="a" if n_done or not destination.exists() else "w",
        rewards=dataset.rewards is not None,
        success=dataset.success is not None,
        extras=dataset.header.extras,
        sources=dataset.header.sources,
        capacity=(len(left), int(dataset.lengths[n_done:].sum())),
    ) as writer:
        states = (_states(dataset, episode, env.scene) for episode in left)
        drawn = map_in_order(functools.partial(_draw, encoded), states, n_workers)
        bar = tqdm(drawn, "rendering", dataset.n_episodes, initial=n_done, unit="episode", disable=not progress)
        for episode, observations in zip(left, bar, strict=True):
            writer.add_episode(observations, **_rest_of_episode(dataset, episode))
    return len(left)


def check_drawable(dataset: OfflineDataset) -> None:
    """
    :param dataset: a dataset; raises ``DatasetError`` if its frames cannot be drawn
    """
    if dataset.env_id != ENV_ID:
        problem = f"is {dataset.env_id!r}: only datasets of {ENV_ID} can be drawn again"
        raise DatasetError(dataset.path, "env_id", problem, "Collect frames in that environment itself")
    if "scene_state" not in dataset.extras:
        remedy = "Collect the dataset again: the data programs keep the scene's states"
        raise DatasetError(dataset.path, STATE, "is missing, so there is nothing to draw from", remedy)


def draw_moments(dataset: OfflineDataset, episode: int, moments: np.ndarray) -> np.ndarray:
    """
    Draw some observations of an episode.

    :param dataset: dataset with the extra ``scene_state``
    :param episode: index of the episode
    :param moments: (n,) int, indices of observations in the episode; 0 is the one before the first step
    :return: (n, 64, 64, 3) uint8; the size differs if the dataset's ``env_kwargs`` name another
    """
    check_drawable(dataset)
    encoded = json.dumps({**dataset.env_kwargs, "obs_type": "pixels"})
    return _draw(encoded, _states(dataset, episode, _shared_env(encoded).scene)[moments])


def _provenance(dataset: OfflineDataset, env: Any) -> dict[str, Any]:
    """:return: everything that decides the bytes of the file; a file is continued only if all of it is the same"""
    digest = hashlib.sha256()
    for name in sorted(name for name in dataset.arrays if not name.startswith("observations")):
        digest.update(name.encode())
        array = dataset.arrays[name]
        for first in range(0, len(array), HASHED_ROWS):
            digest.update(np.asarray(array[first : first + HASHED_ROWS]).tobytes())
    provenance = {
        "program": PROGRAM,
        **({} if env.obs_type == "pixels" else {"obs_type": env.obs_type}),  # older files of images name none
        "frame_size": env.frame_size,
        "camera": env.camera,
        "renderer": env.get_render_device(),
        "versions": {name: importlib.metadata.version(name) for name in ("metaworld", "mujoco")},
        "rendered": {"file": dataset.path.name, "sha256": digest.hexdigest(), "provenance": dataset.provenance},
        "sources": dataset.sources,
    }
    return json.loads(json.dumps(provenance))  # as it is read back from a file: lists instead of tuples


def _episodes_done(path: Path, provenance: Mapping[str, Any]) -> int:
    with open_hdf5(path) as file:
        if read_header(file, path).provenance != provenance:
            problem = "exists already, and is not of this source, size, camera and renderer"
            raise DatasetError(path, "file", problem, "Give another name, or replace the file (--overwrite)")
        return int(file["n_episodes"][()])


@functools.lru_cache(maxsize=1)
def _shared_env(env_kwargs: str) -> Any:
    """Create the one environment that all episodes of a process share."""
    return gym.make(ENV_ID, **json.loads(env_kwargs)).unwrapped


def _states(dataset: OfflineDataset, episode: int, scene: TableScene) -> np.ndarray:
    """:return: (T + 1, 30), the scene states of an episode and the one before its first step, which the file does not hold"""
    start, length = dataset.step_starts[episode], dataset.lengths[episode]
    states = np.asarray(dataset.extras["scene_state"][start : start + length])
    if not np.isfinite(states).all():
        raise DatasetError(dataset.path, STATE, f"holds NaN or infinity in episode {episode}", "Leave that episode out")
    return np.stack([scene.initial_state(states[0]), *states])


def _draw(env_kwargs: str, states: np.ndarray) -> Any:
    """
    :param env_kwargs: arguments of the environment as JSON
    :param states: (n, 30) scene states
    :return: observations of these states, as rows
    """
    env = _shared_env(env_kwargs)
    observations = []
    for state in states:
        env.scene.set_state(state)
        observations.append(env.get_observation())
    return stack_observations(observations)


def _rest_of_episode(dataset: OfflineDataset, episode: int) -> dict[str, Any]:
    """:return: the arguments of ``DatasetWriter.add_episode`` except the observations"""
    steps = slice(dataset.step_starts[episode], dataset.step_starts[episode] + dataset.lengths[episode])
    names = ("actions", "rewards", "terminated", "truncated", "success")
    rest = {name: dataset.arrays[name][steps] for name in names if name in dataset.arrays}
    rest["extras"] = {name: array[steps] for name, array in dataset.extras.items()}
    rest["seed"] = int(dataset.seeds[episode])
    if dataset.source is not None:
        rest["source"] = dataset.sources[dataset.source[episode]]
    return rest
