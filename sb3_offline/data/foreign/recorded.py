"""Tools for formats that store each episode for itself: in a group of an HDF5 file, or in a file of its own."""

import contextlib
import json
import re
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.foreign.base import Foreign, Options
from sb3_offline.data.foreign.episodes import guess_action_space, guess_observation_space
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.format import Header
from sb3_offline.data.spaces import check_observations, check_rows

HDF5_SUFFIXES = (".h5", ".hdf5")
# More than one, so that a damaged first file is named as such
FILES_TO_TRY = 3


@dataclass
class Episode:
    """
    One episode of T steps.

    :param path: file, for error messages
    :param place: beginning of the names of arrays in error messages, e.g. "data/demo_0/"
    :param observations: by key; the key of plain observations is "". They have T + 1 rows, or T rows where the format does not
        store the observation after the last step
    :param steps: ``actions`` and, optionally, ``rewards`` and ``success``, each with T rows
    :param extras: further arrays with T rows, or with T + 1 rows if one row belongs to the reset
    :param terminated: true if the environment ended the episode
    :param truncated: true if the episode was cut off
    :param seed: the seed that the episode was reset with, -1 for none
    :param source: label of the episode's source
    """

    path: Path
    place: str
    observations: dict[str, np.ndarray]
    steps: dict[str, np.ndarray]
    extras: dict[str, np.ndarray] = field(default_factory=dict)
    terminated: bool = False
    truncated: bool = False
    seed: int = -1
    source: str | None = None


def join_episodes(
    episodes: Sequence[Episode],
    path: Path,
    options: Options,
    format_name: str,
    *,
    provenance: Mapping[str, Any] | None = None,
    env_id: str = "",
    env_kwargs: dict[str, Any] | None = None,
) -> Foreign:
    """
    Join episodes that were read one by one.

    Where the observation after the last step is unknown, a terminated episode repeats the observation before that step. Any
    other episode loses that step, as in :func:`~sb3_offline.data.foreign.episodes.cut_episodes`.

    :param episodes: the episodes; their arrays are released as they are joined
    :param path: the file or the folder, for error messages
    :param options: spaces that the caller declares
    :param format_name: name of the format, for error messages
    :param provenance: origin of the data (JSON), apart from the format
    :param env_id: id of the environment, or ""
    :param env_kwargs: keyword arguments of the environment
    :return: the data
    :raises DatasetError: if there is no step, if episodes differ in their arrays, or if an array does not fit its space
    """
    for episode in episodes:
        _check_rows_of(episode)
        _complete(episode)
    episodes = [episode for episode in episodes if len(episode.steps["actions"])]
    if not episodes:
        problem = f"of {format_name} hold no step whose next observation is known"
        raise DatasetError(path, "episodes", problem, "Check that the recording is complete")
    first = episodes[0]
    for episode in episodes:
        _compare(episode, first)
    extras = _extras(episodes)
    has_success = all("success" in episode.steps for episode in episodes)
    labels = sorted({episode.source for episode in episodes if episode.source is not None})
    header = Header(
        options.observation_space or _guess_observations(first.observations),
        options.action_space or _guess_actions(episodes, path, format_name),
        env_id=env_id,
        env_kwargs=env_kwargs or {},
        provenance={"format": format_name, **(provenance or {})},
        sources=labels or None,
        rewards="rewards" in first.steps,
        success=has_success,
        extras={name: (array.shape[1:], array.dtype) for name, array in extras.items()},
    )
    columns: dict[str, list[np.ndarray]] = {}
    for episode in episodes:
        for name, array in _checked(episode, header).items():
            columns.setdefault(name, []).append(array)
    lengths = np.array([len(part) for part in columns["actions"]], dtype=np.int64)
    arrays: dict[str, Any] = {
        "episodes/length": lengths,
        "episodes/seed": np.array([episode.seed for episode in episodes], dtype=np.int64),
    }
    if labels:
        arrays["episodes/source"] = np.array([labels.index(e.source or "") for e in episodes], dtype=np.int16)
    for name in list(columns):
        arrays[name] = np.concatenate(columns.pop(name))
    for name in ("terminated", "truncated"):
        arrays[name] = np.zeros(int(lengths.sum()), dtype=bool)
        arrays[name][np.cumsum(lengths) - 1] = [getattr(episode, name) for episode in episodes]
    arrays |= {f"extras/{name}": array for name, array in extras.items()}
    return Foreign(header, arrays)


def _check_rows_of(episode: Episode) -> None:
    """Check the numbers of rows, and give single numbers an axis of their own, which encoders of vectors need."""
    n = len(episode.steps["actions"])
    for name, array in {**episode.steps, **{f"observation {key}": a for key, a in episode.observations.items()}}.items():
        wanted = (n, n + 1) if name.startswith("observation ") else (n,)
        if array.ndim == 0 or len(array) not in wanted:
            name = name.removeprefix("observation ") or "observations"
            problem = f"has shape {array.shape}, but there are {n} actions"
            remedy = f"Check that the recording is complete: {' or '.join(map(str, wanted))} rows are expected"
            raise DatasetError(episode.path, f"{episode.place}{name}", problem, remedy)
    for name in episode.steps.keys() & {"rewards", "success"}:
        if episode.steps[name].size != n:
            problem = f"has shape {episode.steps[name].shape}, expected ({n},)"
            raise DatasetError(episode.path, f"{episode.place}{name}", problem, "Give one number for each step")
        episode.steps[name] = episode.steps[name].reshape(n)
    lengths = {key: len(array) for key, array in episode.observations.items()}
    if len(set(lengths.values())) > 1:
        raise DatasetError(episode.path, f"{episode.place}observations", f"differ in their rows: {lengths}", "Record it again")
    for key, array in episode.observations.items():
        episode.observations[key] = array[:, None] if array.ndim == 1 else array


def _complete(episode: Episode) -> None:
    """Where the observation after the last step is unknown, repeat the one before it or leave the step out."""
    n = len(episode.steps["actions"])
    if len(next(iter(episode.observations.values()))) == n + 1 or n == 0:
        return
    if episode.terminated:
        episode.observations = {key: np.concatenate([a, a[-1:]]) for key, a in episode.observations.items()}
    else:
        episode.steps = {name: array[:-1] for name, array in episode.steps.items()}
        episode.extras = {name: array[:-1] for name, array in episode.extras.items()}


def _compare(episode: Episode, first: Episode) -> None:
    """Raise ``DatasetError`` if an episode differs from the first one in its arrays."""
    for field_name, mine, theirs in (
        ("observations", episode.observations.keys(), first.observations.keys()),
        ("rewards", episode.steps.keys() & {"rewards"}, first.steps.keys() & {"rewards"}),
    ):
        if mine != theirs:
            problem = f"has {sorted(mine) or 'none'}, but {first.path.name} {first.place} has {sorted(theirs) or 'none'}"
            raise DatasetError(
                episode.path, f"{episode.place}{field_name}", problem, "Record all episodes with the same arrays"
            )
    if episode.steps["actions"].shape[1:] != first.steps["actions"].shape[1:]:
        shape, other = episode.steps["actions"].shape[1:], first.steps["actions"].shape[1:]
        problem = f"has rows of shape {shape}, but those of {first.path.name} {first.place} have {other}"
        raise DatasetError(episode.path, f"{episode.place}actions", problem, "Open episodes of different robots separately")


def _guess_observations(observations: Mapping[str, np.ndarray]) -> spaces.Space:
    guessed: dict[str, spaces.Space] = {key: guess_observation_space(array) for key, array in observations.items()}
    return guessed[""] if "" in guessed else spaces.Dict(guessed)


def _guess_actions(episodes: Sequence[Episode], path: Path, format_name: str) -> spaces.Box:
    actions = np.concatenate([episode.steps["actions"] for episode in episodes])
    return guess_action_space(actions[:, None] if actions.ndim == 1 else actions, path, format_name)


def _checked(episode: Episode, header: Header) -> dict[str, np.ndarray]:
    """:return: the episode's observations and steps with the dtypes of the spaces; what does not fit is named with its file"""
    fields = header.fields()
    arrays: dict[str, np.ndarray] = {}
    plain = "" in episode.observations and not isinstance(header.observation_space, spaces.Dict)
    try:
        observations = episode.observations[""] if plain else episode.observations
        arrays |= check_observations(observations, header.observation_space, None, episode.path)
        for name, array in episode.steps.items():
            if name in fields:
                shape = fields[name].shape
                if array.ndim != len(shape) + 1 and array.size == len(array) * int(np.prod(shape)):
                    array = array.reshape(len(array), *shape)
                arrays[name] = check_rows(array, shape, fields[name].dtype, None, episode.path, name)
    except DatasetError as error:
        raise DatasetError(error.file, f"{episode.place}{error.field}", error.problem, error.remedy) from error
    episode.observations, episode.steps = {}, {"actions": arrays["actions"]}
    return arrays


def _extras(episodes: Sequence[Episode]) -> dict[str, np.ndarray]:
    """
    :return: (N, ...) those further arrays that all episodes have, with the same shape and dtype. The row of a reset is kept
        under ``reset.<name>`` in the first step of its episode, as for Minari, if it holds any information
    """
    joined: dict[str, np.ndarray] = {}
    lengths = [len(episode.steps["actions"]) for episode in episodes]
    for name in dict.fromkeys(name for episode in episodes for name in episode.extras):
        parts = [episode.extras[name] for episode in episodes if name in episode.extras]
        same = len({(part.shape[1:], part.dtype) for part in parts}) == 1 and len(parts) == len(episodes)
        rows = {len(part) - n for part, n in zip(parts, lengths, strict=False) if same}
        if rows not in ({0}, {1}) or parts[0].dtype.kind not in "biufS":
            place = f"{episodes[0].path.name}: {name}"
            warnings.warn(f"{place}: does not have one row of one shape for each step of every episode; it is left out.")
            continue
        joined[name] = np.concatenate([part[len(part) - n :] for part, n in zip(parts, lengths, strict=True)])
        if rows == {1} and any(part[0].any() for part in parts):
            reset = np.zeros_like(joined[name])
            reset[np.cumsum(lengths) - lengths] = np.stack([part[0] for part in parts])
            joined[f"reset.{name}"] = reset
    return joined


# ------------------------------------------------------------- files


def flattened(group: h5py.Group, separator: str = "_", above: str = "") -> dict[str, h5py.Dataset]:
    """
    :param group: a group of an HDF5 file
    :param separator: text between the names of a group and of its member. PyTorch forbids "." in the names of modules, and a
        Dict space forbids "/" in its keys
    :param above: beginning of all names
    :return: the arrays in the group and in the groups below it, by name
    """
    found: dict[str, h5py.Dataset] = {}
    for name, node in group.items():
        name = above + name.replace("/", separator).replace(".", separator)
        parts = flattened(node, separator, name + separator) if isinstance(node, h5py.Group) else {name: node}
        for key, part in parts.items():
            while key in found:  # {"a": {"b": ...}} beside {"a_b": ...}
                key += separator
            found[key] = part
    return found


def chosen(found: Mapping[str, Any], space: spaces.Space | None, path: Path, place: str) -> dict[str, Any]:
    """
    Choose the observations among arrays: all of them, or those that a declared space names.

    :param found: arrays by key (anything with a ``shape``)
    :param space: the declared space. A Dict chooses its keys, and any other space chooses the array that has its shape
    :param path: file for error messages
    :param place: the array or group for error messages
    :return: the chosen arrays by key; the key is "" if the space is no Dict
    :raises DatasetError: if the space does not choose any
    """
    if space is None:
        return dict(found)
    if isinstance(space, spaces.Dict):
        missing = [key for key in space if key not in found]
        if missing:
            problem = f"lacks {missing}, which the given observation_space names"
            raise DatasetError(path, place, problem, f"Give a Dict with some of the keys {sorted(found)}")
        return {key: found[key] for key in space}
    fitting = [array for array in found.values() if tuple(array.shape[1:]) == tuple(space.shape or ())]
    if len(found) == 1 or len(fitting) == 1:
        return {"": fitting[0] if fitting else next(iter(found.values()))}
    problem = f"holds {sorted(found)}, but the given observation_space is {space}"
    raise DatasetError(path, place, problem, "Give a Dict of spaces with some of these keys")


def member(group: h5py.Group, name: str, path: Path, remedy: str = "Check that the recording is complete") -> h5py.Dataset:
    """
    :param group: a group of an HDF5 file
    :param name: name of an array in it
    :param path: file for error messages
    :param remedy: what to do if it is missing
    :return: the array
    :raises DatasetError: if there is no such array
    """
    found = group.get(name)
    if not isinstance(found, h5py.Dataset):
        problem = "is missing" if found is None else "is a group, expected an array"
        raise DatasetError(path, f"{group.name.strip('/')}/{name}".strip("/"), problem, remedy)
    return found


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """
    :param path: an ``.npz`` file
    :return: its arrays; pickled ones are left out, because loading them could run code
    :raises DatasetError: if the file is damaged
    """
    arrays = {}
    with readable(path), np.load(path, allow_pickle=False) as file:
        for name in file.files:
            try:
                arrays[name] = file[name]
            except ValueError as error:
                if "allow_pickle" not in str(error):
                    raise
                warnings.warn(f"{path}: {name}: is pickled; it is left out.")
    return arrays


@contextlib.contextmanager
def readable(path: Path) -> Iterator[None]:
    """
    :param path: the file that the block reads
    :return: context manager that turns the errors of damaged files into ``DatasetError``
    """
    try:
        yield
    except DatasetError:
        raise
    except (OSError, EOFError, LookupError, ValueError, TypeError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        problem = f"cannot be read ({type(error).__name__}: {' '.join(str(error).split())})"
        raise DatasetError(path, "file", problem, "Copy, download or record it again") from error


def numbered(names: Iterator[str] | Sequence[str]) -> list[str]:
    """
    :param names: names with numbers in them
    :return: the names in the order of their numbers: "demo_2" comes before "demo_10"
    """
    return sorted(
        names, key=lambda name: [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]
    )


def files_in(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """
    :param folder: a folder
    :param suffixes: suffixes of file names, in lower case
    :return: the files with such a suffix, in the order of their numbers; hidden ones are left out
    """
    names = [entry.name for entry in folder.iterdir() if entry.suffix.lower() in suffixes and not entry.name.startswith(".")]
    return [folder / name for name in numbered(names)]


def any_file(files: Sequence[Path], recognizes: Callable[[Probe], bool]) -> bool:
    """
    :param files: files of a folder
    :param recognizes: whether a file has a format
    :return: whether one of the first files has it. The others are not opened, because there may be many
    """
    for path in files[:FILES_TO_TRY]:
        with Probe(path) as probe:
            if probe.kind != "folder" and recognizes(probe):
                return True
    return False


def plain_attributes(node: h5py.Group) -> dict[str, Any]:
    """
    :param node: a group of an HDF5 file
    :return: its attributes as JSON values; a text that is JSON itself is decoded, and what is no JSON is left out
    """
    values: dict[str, Any] = {}
    for name, value in node.attrs.items():
        value = value.decode(errors="replace") if isinstance(value, bytes) else value
        with contextlib.suppress(ValueError, TypeError):
            value = json.loads(value) if isinstance(value, str) and value[:1] in "{[" else value
        value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        with contextlib.suppress(ValueError, TypeError):
            values[name] = json.loads(json.dumps(value))
    return values
