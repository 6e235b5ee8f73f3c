"""
Minari datasets, in and out.

Nothing is lost in either direction. Infos become ``extras`` (``success`` becomes the success labels), and extras become
infos. Minari has one more row of infos than there are steps, that of the reset: where it says anything, it stands in an
array of its own, ``reset.<name>``, in the row of the episode's first step. Rewards and actions that float32 would round are
kept exactly in ``exact.rewards`` and ``exact.actions``. Metadata go to ``provenance["minari"]``, those of episodes (options
of their resets) to ``episode_metadata``, as JSON in the row of the first step.
"""

import json
import os
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.flat import checked_observations
from sb3_offline.data.format import Header
from sb3_offline.data.spaces import check_rows, space_to_json, subspaces

if TYPE_CHECKING:
    from sb3_offline.data.reader import OfflineDataset

PREFIX = "minari:"
# What a copy's metadata say by themselves
OF_THE_COPY = {
    "dataset_id",
    "observation_space",
    "action_space",
    "total_episodes",
    "total_steps",
    "data_format",
    "dataset_size",
    "jpeg_encoding",
    "minari_version",
    "sb3_offline",
}
LABELS = "episode_metadata"
EXACT = {"rewards": "exact.rewards", "actions": "exact.actions"}


def dataset_folder(source: str | os.PathLike) -> Path:
    """
    :param source: ``minari:(namespace/)name-vN``
    :return: where Minari keeps it (or would): under ``MINARI_DATASETS_PATH``, or ``~/.minari/datasets``
    """
    try:
        from minari.dataset.minari_dataset import parse_dataset_id
        from minari.storage.datasets_root_dir import get_dataset_path
    except ModuleNotFoundError as error:
        message = f'{source} needs the package minari; install it with: pip install "sb3-offline[minari]"'
        raise ModuleNotFoundError(message, name=error.name) from error
    name = os.fspath(source).removeprefix(PREFIX)
    try:
        parse_dataset_id(name)
    except (ValueError, TypeError) as error:  # TypeError: a name without a version
        raise DatasetError(source, "name", "is no id of a Minari dataset", f"Give {PREFIX}(namespace/)name-vN") from error
    return Path(get_dataset_path(name)).absolute()


def is_minari(path: Path) -> bool:
    """:return: whether a folder holds a Minari dataset"""
    return (path / "data" / "metadata.json").is_file()


def read_minari(path: Path) -> tuple[Header, dict[str, Any]]:
    """
    Read a Minari dataset into memory, as the arrays of our format.

    :param path: the dataset's folder
    :return: header and arrays by name, as ``Header.fields`` names them
    """
    from minari import MinariDataset

    try:
        dataset = MinariDataset(path / "data")
        metadata = dataset.storage.read_raw_metadata(path / "data")
        ids = [int(index) for index in dataset.episode_indices]
        episodes = list(dataset.storage.get_episodes(ids))
        labels = [dict(label) for label in dataset.storage.get_episode_metadata(ids)]
    except (OSError, KeyError, ValueError, AssertionError, NotImplementedError) as error:
        raise DatasetError(path, "dataset", f"cannot be read by Minari ({error})", "Download or create it again") from error
    for space in (dataset.observation_space, dataset.action_space):
        space_to_json(space)  # refuses what cannot be stored
    if not episodes:
        raise DatasetError(path, "total_episodes", "is 0", "Give a dataset with episodes")
    lengths = np.array([len(episode["rewards"]) for episode in episodes], dtype=np.int64)
    ours = metadata.get("sb3_offline", {})
    steps = {
        "actions": np.concatenate([np.asarray(episode["actions"]) for episode in episodes]),
        "terminated": np.concatenate([episode["terminations"] for episode in episodes]),
        "truncated": np.concatenate([episode["truncations"] for episode in episodes]),
    }
    if ours.get("rewards", True):
        steps["rewards"] = np.concatenate([episode["rewards"] for episode in episodes])
    extras, infos = _infos_as_extras([episode["infos"] or {} for episode in episodes], lengths, path)
    for name in EXACT.keys() & steps.keys():
        if steps[name].dtype == np.float64 and not np.array_equal(steps[name], steps[name].astype(np.float32)):
            extras[EXACT[name]] = steps[name]
    if "success" in extras and extras["success"].dtype == bool and extras["success"].ndim == 1:
        steps["success"] = extras.pop("success")

    texts = _labels(labels, np.cumsum(lengths) - lengths, int(lengths.sum()))
    if texts is not None:
        extras[LABELS] = texts
    kept = {name: value for name, value in metadata.items() if name not in OF_THE_COPY}
    spec = json.loads(kept["env_spec"]) if "env_spec" in kept else {"id": ours.get("env_id"), "kwargs": ours.get("env_kwargs")}
    header = Header(
        dataset.observation_space,
        dataset.action_space,
        env_id=spec["id"] or "",
        env_kwargs=spec.get("kwargs") or {},
        provenance={**ours.get("provenance", {}), "minari": {"metadata": kept, "infos": infos}},
        sources=ours.get("sources"),
        rewards="rewards" in steps,
        success="success" in steps,
        extras={name: (array.shape[1:], array.dtype) for name, array in extras.items()},
    )
    arrays: dict[str, Any] = {f"extras/{name}": array for name, array in extras.items()}
    arrays["episodes/length"] = lengths
    arrays["episodes/seed"] = np.array([-1 if label.get("seed") is None else label["seed"] for label in labels], np.int64)
    if header.sources is not None:
        arrays["episodes/source"] = np.array([header.sources.index(label["source"]) for label in labels], np.int16)
    observations = {}
    for name in subspaces(dataset.observation_space, "observations"):
        key = name.removeprefix("observations").removeprefix("/")
        parts = [episode["observations"][key] if key else episode["observations"] for episode in episodes]
        observations[name] = np.concatenate([np.asarray(part) for part in parts])
    arrays |= checked_observations(observations, dataset.observation_space, path)
    fields = header.fields()
    for name, array in steps.items():
        arrays[name] = check_rows(array, fields[name].shape, fields[name].dtype, int(lengths.sum()), path, name)
    return header, arrays


def _infos_as_extras(
    episodes: list[dict[str, Any]], lengths: np.ndarray, path: Path
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """
    :return: extras by name, and what :func:`write_minari` needs to undo it: the keys of each, and whether there was a row
        for the reset
    """
    leaves = [dict(_leaves(infos)) for infos in episodes]
    extras: dict[str, np.ndarray] = {}
    undo: dict[str, Any] = {}
    for keys in dict.fromkeys(keys for episode in leaves for keys in episode):
        parts = [np.asarray(episode[keys]) for episode in leaves if keys in episode]
        resets = {len(part) - n for part, n in zip(parts, lengths, strict=False)} if len(parts) == len(lengths) else set()
        texts = all(part.dtype == object and all(isinstance(row, bytes) for row in part.flat) for part in parts)
        same = len({(part.shape[1:], part.dtype) for part in parts}) == 1
        if resets not in ({0}, {1}) or not same or not (texts or parts[0].dtype.kind in "biufS"):
            problem = "is not in every episode, with a number, a text or an array of one shape for each step"
            warnings.warn(f"{path}: infos/{'/'.join(keys)}: {problem}; it is left out.")
            continue
        name, has_reset = ".".join(keys), resets == {1}
        while {name, f"reset.{name}", name.removeprefix("reset.")} & extras.keys():  # {"a": {"b": ...}} beside {"a.b": ...}
            name += "_"
        rows = np.concatenate([part[int(has_reset) :] for part in parts])
        extras[name] = rows.astype("S") if texts else rows
        undo[name] = {"keys": list(keys), "reset": has_reset}
        if has_reset:
            first = np.stack([part[0] for part in parts])
            if texts or first.any():
                at_reset = np.zeros_like(rows, dtype=first.astype("S").dtype if texts else None)
                at_reset[np.cumsum(lengths) - lengths] = first
                extras[f"reset.{name}"] = at_reset
    return extras, undo


def _leaves(infos: dict[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, value in infos.items():
        if isinstance(value, dict):
            yield from _leaves(value, (*above, key))
        else:
            yield (*above, key), value


def _labels(labels: list[dict[str, Any]], starts: np.ndarray, n_steps: int) -> np.ndarray | None:
    """:return: (n_steps,) metadata of the episodes that have no arrays of their own, as JSON in first steps"""
    others = [{k: v for k, v in label.items() if k not in ("id", "seed", "total_steps", "source")} for label in labels]
    if not any(others):
        return None
    texts = np.array([json.dumps(label, default=lambda value: np.asarray(value).tolist()).encode() for label in others])
    rows = np.zeros(n_steps, dtype=texts.dtype)
    rows[starts] = texts
    return rows


def write_minari(dataset: "OfflineDataset", destination: str) -> None:
    """
    Write a dataset as a Minari dataset, whole or not at all. Images are stored raw, not as JPEG, which would change them.

    :param dataset: any dataset
    :param destination: ``minari:(namespace/)name-vN``; there must be none of that name
    """
    folder = dataset_folder(destination)
    if folder.exists():
        remedy = f"Give another name or version, or delete it (minari delete {destination.removeprefix(PREFIX)})"
        raise DatasetError(folder, "dataset", "exists already", remedy)
    import minari

    metadata = dict(dataset.provenance.get("minari", {}).get("metadata", {}))
    for name in ("author", "author_email"):
        if name in metadata:
            metadata[name] = set(metadata[name])
    header = dataset.header
    if "env_spec" not in metadata and header.env_id in gym.registry:
        spec = gym.spec(header.env_id)
        spec.kwargs.update(header.env_kwargs)
        metadata["env_spec"] = spec.to_json()
    metadata["sb3_offline"] = {
        "env_id": header.env_id,
        "env_kwargs": header.env_kwargs,
        "provenance": {name: value for name, value in dataset.provenance.items() if name != "minari"},
        "sources": header.sources,
        "rewards": header.rewards,
    }
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of an author and the like that nobody named
            written = minari.create_dataset_from_buffers(
                destination.removeprefix(PREFIX),
                _episodes(dataset),  # type: ignore[arg-type]
                observation_space=dataset.observation_space,
                action_space=dataset.action_space,
                jpeg_encoding=False,
            )
        written.storage.update_metadata(metadata)
        labels: list[dict[str, Any]] = [{} for _ in range(dataset.n_episodes)]
        if LABELS in dataset.extras:
            labels = [json.loads(dataset.extras[LABELS][start]) for start in dataset.step_starts]
        if dataset.source is not None:
            labels = [{**label, "source": dataset.sources[index]} for label, index in zip(labels, dataset.source, strict=True)]
        if any(labels):
            written.storage.update_episode_metadata(
                [{"/".join(keys): value for keys, value in _leaves(label)} for label in labels]
            )
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _episodes(dataset: "OfflineDataset") -> Iterator[Any]:
    """:return: Minari's buffers, one episode after another"""
    from minari.data_collector.episode_buffer import EpisodeBuffer

    undo = dataset.provenance.get("minari", {}).get("infos", {})
    per_step = {name: array for name, array in dataset.extras.items() if name not in (LABELS, *EXACT.values())}
    if dataset.success is not None:
        per_step["success"] = dataset.success
    resets = {name: per_step.pop(f"reset.{name}") for name in list(per_step) if f"reset.{name}" in per_step}
    is_dict = isinstance(dataset.observation_space, spaces.Dict)
    for episode in range(dataset.n_episodes):
        n, first, first_row = dataset.lengths[episode], dataset.step_starts[episode], dataset.observation_starts[episode]

        def rows(name: str, first: int = first, n: int = n) -> np.ndarray:
            return dataset.arrays[name][first : first + n]

        infos: dict[str, Any] = {}
        for name, array in per_step.items():
            how = undo.get(name, {"keys": [name], "reset": True})
            values = array[first : first + n]
            if how["reset"]:
                reset = resets[name][first : first + 1] if name in resets else np.zeros_like(values[:1])
                values = np.concatenate([reset, values])
            leaf = infos
            for key in how["keys"][:-1]:
                leaf = leaf.setdefault(key, {})
            leaf[how["keys"][-1]] = [text.decode() for text in values] if values.dtype.kind == "S" else values
        exact = {name: f"extras/{EXACT[name]}" if EXACT[name] in dataset.extras else name for name in EXACT}
        observations = {
            name.removeprefix("observations/"): dataset.arrays[name][first_row : first_row + n + 1]
            for name in subspaces(dataset.observation_space, "observations")
        }
        yield EpisodeBuffer(
            id=episode,
            seed=None if dataset.seeds[episode] == -1 else int(dataset.seeds[episode]),
            observations=observations if is_dict else observations["observations"],
            actions=rows(exact["actions"]),
            rewards=rows(exact["rewards"]) if dataset.rewards is not None else np.zeros(n, np.float32),  # type: ignore[arg-type]
            terminations=rows("terminated"),  # type: ignore[arg-type]
            truncations=rows("truncated"),  # type: ignore[arg-type]
            infos=infos or None,
        )
