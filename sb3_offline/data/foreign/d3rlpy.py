"""HDF5 files of d3rlpy: ``ReplayBuffer.dump`` of version 2, and ``MDPDataset.dump`` of version 1."""

from typing import Any

import h5py
import numpy as np

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.foreign.base import Foreign, Format, Options
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.foreign.trajectories import join_trajectories

REQUIRED = ("columns", "num_episodes")
# D4RL's names, and one of d3rlpy's own
OLD_REQUIRED = ("observations", "actions", "rewards", "terminals")
OLD_ONLY = ("episode_terminals", "discrete_action")
COLUMNS = ("observations", "actions", "rewards", "terminated")


def recognizes(probe: Probe) -> bool:
    """
    :param probe: a path or an object
    :return: whether it is an HDF5 file with arrays as d3rlpy writes them
    """
    return probe.hdf5 is not None and (probe.names.issuperset(REQUIRED) or _is_old(probe))


def _is_old(probe: Probe) -> bool:
    return probe.names.issuperset(OLD_REQUIRED) and bool(probe.names & set(OLD_ONLY))


def read(probe: Probe, options: Options) -> Foreign:
    """
    Read the episodes of a file into memory.

    d3rlpy keeps one observation for each step, not the one after the last step, see
    :func:`~sb3_offline.data.foreign.episodes.cut_episodes`. Episodes that did not terminate were truncated. Observations that
    consist of several arrays become a Dict with the keys "0", "1", ...

    :param probe: the file
    :param options: ``observation_space`` (default: unbounded, 0 to 255 for uint8, of the data's shape) and ``action_space``
        (default: [-1, 1])
    :return: the data
    """
    assert probe.hdf5 is not None
    try:
        episodes = _old_episodes(probe.hdf5) if _is_old(probe) else _episodes(probe)
    except (OSError, KeyError, TypeError, ValueError) as error:
        problem = f"cannot be read as data of d3rlpy ({str(error).strip()})"
        raise DatasetError(probe.path, "file", problem, "Write it again with d3rlpy (ReplayBuffer.dump)") from error
    if not episodes:
        raise DatasetError(probe.path, "num_episodes", "is 0", "Give a file with episodes")
    return join_trajectories(episodes, probe.path, options, "d3rlpy")


def _episodes(probe: Probe) -> list[dict[str, Any]]:
    file = probe.hdf5
    assert file is not None
    n_episodes = int(file["num_episodes"][()])
    columns = [name.decode() for name in file["columns"][()]]
    missing = [name for name in COLUMNS if name not in columns]
    if missing:
        problem = f"has no {', '.join(missing)}, only {', '.join(columns)}"
        raise DatasetError(probe.path, "columns", problem, "Dump episodes of the kind d3rlpy.dataset.Episode")

    def rows(name: str, index: int) -> Any:
        if (whole := file.get(f"{name}_{index}")) is not None:
            return whole[()]
        parts: dict[str, np.ndarray] = {}
        while (part := file.get(f"{name}_{index}_{len(parts)}")) is not None:
            parts[str(len(parts))] = part[()]
        if not parts:
            problem = f"is missing, but num_episodes is {n_episodes}"
            raise DatasetError(probe.path, f"{name}_{index}", problem, "Copy the file again, or write it again")
        return parts

    episodes = []
    for index in range(n_episodes):
        episode = {name: rows(name, index) for name in COLUMNS}
        episode["terminals"] = np.zeros(len(episode["actions"]), dtype=bool)
        episode["terminals"][-1:] = bool(episode.pop("terminated"))
        episodes.append(episode)
    return episodes


def _old_episodes(file: h5py.File) -> list[dict[str, Any]]:
    """:return: one dict for all episodes, whose ends it tells by terminals and timeouts"""
    episode: dict[str, Any] = {name: file[name][()] for name in OLD_REQUIRED}
    episode["terminals"] = terminals = episode["terminals"].reshape(-1).astype(bool)
    if "episode_terminals" in file:
        episode["timeouts"] = file["episode_terminals"][()].reshape(-1).astype(bool) & ~terminals
    return [episode]


FORMAT = Format(
    name="d3rlpy",
    description=f"an HDF5 file of ReplayBuffer.dump, with {', '.join(REQUIRED)} and arrays for each episode",
    recognizes=recognizes,
    read=read,
    declares_spaces=False,
    refines=("D4RL",),
)
