"""robomimic: a group for each demonstration in an HDF5 file. LIBERO, robosuite and MimicGen write the same layout."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.foreign.base import Foreign, Format, Options
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.foreign.recorded import (
    Episode,
    chosen,
    flattened,
    join_episodes,
    member,
    numbered,
    plain_attributes,
    readable,
)

NAME = "robomimic"
# All other arrays of a demonstration become extras.
READ = ("actions", "rewards", "dones")
SPLITS = ("train", "valid")


def recognizes(probe: Probe) -> bool:
    """
    :param probe: a path or an object
    :return: whether it is an HDF5 file with the group ``data`` of demonstrations
    """
    data = probe.hdf5.get("data") if probe.hdf5 is not None else None
    return isinstance(data, h5py.Group) and ("env_args" in data.attrs or any(name.startswith("demo") for name in data))


def read(probe: Probe, options: Options) -> Foreign:
    """
    Read demonstrations into memory.

    ``dones`` in the last step says that the demonstration ended. The end is a termination, except where 0/1 rewards say that
    it ended without success, or where it has the length ``max_episode_steps``; these are truncations. Files without
    ``next_obs`` (LIBERO) do not hold the last observation, see
    :func:`~sb3_offline.data.foreign.recorded.join_episodes`.

    The masks ``train`` and ``valid`` become sources, and every mask becomes an extra ``mask.<name>``.

    :param probe: the file
    :param options: ``observation_space`` (default: a Dict of all of ``obs``; a Dict with some of the keys reads these alone),
        ``action_space`` (default: [-1, 1]) and ``max_episode_steps``
    :return: the data
    """
    path, file = probe.path, probe.hdf5
    assert file is not None
    with readable(path):
        data = file["data"]
        names = numbered([name for name in data if isinstance(data[name], h5py.Group)])
        if not names:
            raise DatasetError(path, "data", "holds no demonstration (demo_0, ...)", "Check that the recording is complete")
        masks = _masks(file, names, path)
        episodes = [_episode(data[name], path, options) for name in names]
        attributes = plain_attributes(data)
    for name, episode in zip(names, episodes, strict=True):
        n = len(episode.steps["actions"])
        episode.extras |= {f"mask.{mask}": np.full(n, name in members) for mask, members in masks.items()}
        if set(SPLITS) <= masks.keys() and not masks["train"] & masks["valid"]:
            episode.source = next((split for split in SPLITS if name in masks[split]), "neither")
    return join_episodes(episodes, path, options, NAME, provenance={NAME: {**attributes, "demonstrations": names}})


def _masks(file: h5py.File, names: list[str], path: Path) -> dict[str, set[str]]:
    """:return: the names of the demonstrations in each mask"""
    group, masks = file.get("mask"), {}
    for mask in group if isinstance(group, h5py.Group) else ():
        members = {m.decode() if isinstance(m, bytes) else str(m) for m in np.ravel(member(group, mask, path)[()])}
        if not members <= set(names):
            problem = f"names {numbered(list(members - set(names)))[0]}, which is not in the group data"
            raise DatasetError(path, f"mask/{mask}", problem, "Copy the file again, or delete the mask")
        masks[mask] = members
    return masks


def _episode(demo: h5py.Group, path: Path, options: Options) -> Episode:
    place = demo.name.strip("/") + "/"
    observations, following = demo.get("obs"), demo.get("next_obs")
    if not isinstance(observations, h5py.Group) or not len(observations):
        remedy = "Extract the observations first: python -m robomimic.scripts.dataset_states_to_obs"
        raise DatasetError(path, f"{place}obs", "is missing: robomimic stores simulator states until then", remedy)
    actions = member(demo, "actions", path)[()]
    n = len(actions)
    if demo.attrs.get("num_samples", n) != n:
        problem = f"has {n} rows, but num_samples is {demo.attrs['num_samples']}"
        raise DatasetError(path, f"{place}actions", problem, "Copy or record the file again")
    arrays = chosen(flattened(observations), options.observation_space, path, f"{place}obs")
    names = {array.name.split("/obs/", 1)[1]: key for key, array in arrays.items()}
    rows = {key: array[()] for key, array in arrays.items()}
    if isinstance(following, h5py.Group) and n:
        for name, key in names.items():
            last = member(following, name, path)
            if last.shape != rows[key].shape:
                problem = f"has shape {last.shape}, but obs/{name} has {rows[key].shape}"
                raise DatasetError(path, f"{place}next_obs/{name}", problem, "Copy or record the file again")
            rows[key] = np.concatenate([rows[key], last[-1:]])
    steps: dict[str, np.ndarray] = {"actions": actions}
    if "rewards" in demo:
        steps["rewards"] = member(demo, "rewards", path)[()].reshape(-1)
    dones = member(demo, "dones", path)[()].reshape(-1).astype(bool) if "dones" in demo else np.zeros(n, dtype=bool)
    if len(dones) != n:
        problem = f"has {len(dones)} rows, but there are {n} actions"
        raise DatasetError(path, f"{place}dones", problem, "Copy or record the file again")
    extras = _extras(demo)
    if dones[:-1].any():
        extras["dones"] = dones
    ended = bool(n and dones[-1])
    rewards = steps.get("rewards", np.zeros(0))
    failed = len(rewards) > 0 and bool(np.isin(rewards, (0, 1)).all() and rewards[-1] == 0)
    terminated = ended and not failed and n != options.max_episode_steps
    return Episode(path, place, rows, steps, extras, terminated, truncated=ended and not terminated)


def _extras(demo: h5py.Group) -> dict[str, np.ndarray]:
    extras: dict[str, Any] = {}
    for name, node in demo.items():
        if name in (*READ, "obs", "next_obs"):
            continue
        arrays = flattened(node, ".", f"{name}.") if isinstance(node, h5py.Group) else {name: node}
        extras |= {key: array[()] for key, array in arrays.items() if array.ndim}
    return extras


FORMAT = Format(
    name=NAME,
    description="an HDF5 file with the groups data/demo_0, ... (LIBERO and robosuite too)",
    recognizes=recognizes,
    read=read,
    declares_spaces=False,
)
