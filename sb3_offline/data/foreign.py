"""Data of other libraries: which of them a path holds."""

from pathlib import Path
from typing import Any, NamedTuple

from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.format import Header
from sb3_offline.data.imitation import read_imitation
from sb3_offline.data.minari import is_minari, read_minari
from sb3_offline.data.replay_buffers import read_replay_buffer


class Foreign(NamedTuple):
    """
    What was read.

    :param header: spaces, attributes, and which arrays there are
    :param arrays: by name, as ``Header.fields`` names them
    :param declares_spaces: whether the source says what its spaces are
    """

    header: Header
    arrays: dict[str, Any]
    declares_spaces: bool


def read_foreign(
    path: Path,
    observation_space: spaces.Space | None = None,
    action_space: spaces.Space | None = None,
    max_episode_steps: int | None = None,
) -> Foreign | None:
    """
    :param path: a file or a folder
    :param observation_space: where the source declares none
    :param action_space: where the source declares none
    :param max_episode_steps: time limit of the environment, where the source calls all ends terminal
    :return: its data, read into memory; ``None`` for an HDF5 file (or anything else)
    """
    if path.is_dir():
        if is_minari(path):
            return Foreign(*read_minari(path), True)
        if not (path / "state.json").is_file():
            problem = "is neither a Minari dataset nor a folder of imitation's rollouts"
            raise DatasetError(path, "folder", problem, "Give a file, a pattern of files, or one of these folders")
    if path.is_dir() or path.suffix == ".npz":
        return Foreign(*read_imitation(path, observation_space, action_space, max_episode_steps), False)
    if path.suffix in (".pkl", ".pickle"):
        return Foreign(*read_replay_buffer(path, max_episode_steps), True)
    return None
