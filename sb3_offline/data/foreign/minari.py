"""
Minari datasets, read and written.

Nothing is lost in either direction. Infos become ``extras`` (``success`` becomes the success labels), and extras become
infos. Minari has one more row of infos than there are steps, the row of the reset. If it is not empty, it is kept in an array
of its own, ``reset.<name>``, in the row of the episode's first step. Rewards and actions that float32 would round are kept
exactly in ``exact.rewards`` and ``exact.actions``. Metadata are kept in ``provenance["minari"]``. The metadata of single
episodes (options of their resets) are kept in ``episode_metadata``, as JSON in the row of the first step.
"""

import contextlib
import json
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import WriteLock, open_hdf5
from sb3_offline.data.foreign.base import Foreign, Format, Options, Scheme
from sb3_offline.data.foreign.episodes import checked_observations
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.format import Header
from sb3_offline.data.plain import check_all_plain
from sb3_offline.data.spaces import check_rows, space_to_json, subspaces

PREFIX = "minari:"
DATASET_CLASS = "minari.dataset.minari_dataset.MinariDataset"
ROOT_VARIABLE = "MINARI_DATASETS_PATH"
# Metadata that each dataset has of its own: a copy does not take them over.
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


def dataset_folder(name: str) -> Path:
    """
    :param name: (namespace/)name-vN
    :return: the folder in which Minari keeps the dataset, or would keep it: under ``MINARI_DATASETS_PATH``, or
        ``~/.minari/datasets``
    """
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.storage.datasets_root_dir import get_dataset_path

    try:
        parse_dataset_id(name)
    except (ValueError, TypeError) as error:  # TypeError: a name without a version
        remedy = f"Give {PREFIX}(namespace/)name-vN"
        raise DatasetError(PREFIX + name, "name", "is no ID of a Minari dataset", remedy) from error
    return Path(get_dataset_path(name)).absolute()


def recognizes(probe: Probe) -> bool:
    """
    :param probe: a path or an object
    :return: whether it is a ``MinariDataset``, the folder of one, the folder ``data`` inside of it, or the HDF5 file in that
    """
    if probe.is_object:  # told by name, so that minari is not imported for other objects
        return any(f"{cls.__module__}.{cls.__name__}" == DATASET_CLASS for cls in type(probe.given).__mro__)
    return _data_folder(probe) is not None


def _data_folder(probe: Probe) -> Path | None:
    """:return: the folder of the metadata and the episodes, if it is a Minari dataset"""
    if probe.kind == "folder":
        if (probe.path / "data" / "metadata.json").is_file():
            return probe.path / "data"
        metadata = probe.json("metadata.json")
        return probe.path if isinstance(metadata, dict) and "total_episodes" in metadata else None
    is_inside = "episode_0" in probe.names and (probe.path.parent / "metadata.json").is_file()
    return probe.path.parent if probe.kind == "HDF5" and is_inside else None


def read(probe: Probe, options: Options) -> Foreign:
    """
    Read a Minari dataset into memory.

    :param probe: the folder, or the ``MinariDataset``, of which only the chosen episodes are read
    :param options: none is needed, since Minari declares all of them
    :return: the data
    """
    from minari import MinariDataset

    path, folder = probe.path, _data_folder(probe) or probe.path
    probe.close()
    if not probe.is_object:  # the library follows links and external storage in this file
        for file in sorted(folder.glob("*.hdf5")):
            with open_hdf5(file) as opened:
                check_all_plain(opened, file)
    try:
        dataset = probe.given if probe.is_object else MinariDataset(folder)
        folder = Path(dataset.storage.data_path)
        metadata = dataset.storage.read_raw_metadata(folder)
        ids = [int(index) for index in dataset.episode_indices]
        episodes = list(dataset.storage.get_episodes(ids))
        labels = [dict(label) for label in dataset.storage.get_episode_metadata(ids)]
    except (OSError, KeyError, ValueError, AssertionError, NotImplementedError) as error:
        raise DatasetError(path, "dataset", f"cannot be read by Minari ({error})", "Download or create it again") from error
    for space in (dataset.observation_space, dataset.action_space):
        space_to_json(space)  # raises if the space cannot be stored
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
    return Foreign(header, arrays)


def _infos_as_extras(
    episodes: list[dict[str, Any]], lengths: np.ndarray, path: Path
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """
    :return: extras by name, and for each what :func:`write` needs to turn it into infos again: the keys, and whether there was
        a row of the reset
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
            problem = "does not have a number, a text or an array of one shape for each step of every episode"
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
    """:return: (n_steps,) those metadata of episodes for which there are no other arrays, as JSON in first steps"""
    others = [{k: v for k, v in label.items() if k not in ("id", "seed", "total_steps", "source")} for label in labels]
    if not any(others):
        return None
    texts = np.array([json.dumps(label, default=lambda value: np.asarray(value).tolist()).encode() for label in others])
    rows = np.zeros(n_steps, dtype=texts.dtype)
    rows[starts] = texts
    return rows


def write(header: Header, arrays: Mapping[str, Any], name: str) -> None:
    """
    Write a Minari dataset, completely or not at all. Images are stored raw, since JPEG would change them.

    :param header: of the dataset
    :param arrays: by name, as ``Header.fields`` names them
    :param name: ``minari:(namespace/)name-vN``; there must be no dataset of that name
    """
    name = name.removeprefix(PREFIX)
    folder = dataset_folder(name)
    # Minari writes to the folder of all its datasets, so it is given another one, from which the whole dataset is moved. The
    # root is where Minari keeps a dataset without a namespace.
    root = dataset_folder(name.rpartition("/")[2]).parent
    flat = name.replace("/", "%")
    with WriteLock(root / f"{flat}.dataset"):
        if folder.exists():
            remedy = f"Give another name or version, or delete it (minari delete {name})"
            raise DatasetError(folder, "dataset", "exists already", remedy)
        staging = root / f".{flat}.tmp"
        shutil.rmtree(staging, ignore_errors=True)  # left by a killed process: we hold the lock, so no other is alive
        staging.mkdir(parents=True)
        try:
            with _root_of_minari(staging):
                _create(header, arrays, name)
            _create_namespace(name)
            os.replace(staging / name, folder)
        finally:
            shutil.rmtree(staging, ignore_errors=True)


@contextlib.contextmanager
def _root_of_minari(root: Path) -> Iterator[None]:
    """Let Minari keep its datasets in another folder. It reads the variable at each call."""
    before = os.environ.get(ROOT_VARIABLE)
    os.environ[ROOT_VARIABLE] = str(root)
    try:
        yield
    finally:
        if before is None:
            del os.environ[ROOT_VARIABLE]
        else:
            os.environ[ROOT_VARIABLE] = before


def _create_namespace(name: str) -> None:
    """Register the namespace of a dataset with Minari, as it does when it creates a dataset."""
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.namespace import create_namespace, list_local_namespaces

    namespace = parse_dataset_id(name)[0]
    if namespace is not None and namespace not in list_local_namespaces():
        create_namespace(namespace)


def _create(header: Header, arrays: Mapping[str, Any], name: str) -> None:
    import minari

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # Minari warns about a missing author and the like
        written = minari.create_dataset_from_buffers(
            name,
            _episodes(header, arrays),  # type: ignore[arg-type]
            observation_space=header.observation_space,
            action_space=header.action_space,
            jpeg_encoding=False,
        )
    written.storage.update_metadata(_metadata(header))
    labels = _episode_metadata(header, arrays)
    if any(labels):
        written.storage.update_episode_metadata(
            [{"/".join(keys): value for keys, value in _leaves(label)} for label in labels]
        )


def _metadata(header: Header) -> dict[str, Any]:
    """:return: metadata of the dataset: those that it was read with, and what Minari has no place for"""
    metadata = dict(header.provenance.get("minari", {}).get("metadata", {}))
    for name in ("author", "author_email"):
        if name in metadata:
            metadata[name] = set(metadata[name])
    if "env_spec" not in metadata and header.env_id in gym.registry:
        spec = gym.spec(header.env_id)
        spec.kwargs.update(header.env_kwargs)
        metadata["env_spec"] = spec.to_json()
    metadata["sb3_offline"] = {
        "env_id": header.env_id,
        "env_kwargs": header.env_kwargs,
        "provenance": {name: value for name, value in header.provenance.items() if name != "minari"},
        "sources": header.sources,
        "rewards": header.rewards,
    }
    return metadata


def _episode_metadata(header: Header, arrays: Mapping[str, Any]) -> list[dict[str, Any]]:
    """:return: metadata of each episode: those that it was read with, and the label of its source"""
    lengths = np.asarray(arrays["episodes/length"])
    labels: list[dict[str, Any]] = [{} for _ in lengths]
    if LABELS in header.extras:
        labels = [json.loads(arrays[f"extras/{LABELS}"][start]) for start in np.cumsum(lengths) - lengths]
    if header.sources is not None:
        indices = np.asarray(arrays["episodes/source"])
        labels = [{**label, "source": header.sources[index]} for label, index in zip(labels, indices, strict=True)]
    return labels


def _episodes(header: Header, arrays: Mapping[str, Any]) -> Iterator[Any]:
    """:return: Minari's buffers, one episode after another"""
    from minari.data_collector.episode_buffer import EpisodeBuffer

    undo = header.provenance.get("minari", {}).get("infos", {})
    per_step = {name: arrays[f"extras/{name}"] for name in header.extras if name not in (LABELS, *EXACT.values())}
    if header.success:
        per_step["success"] = arrays["success"]
    resets = {name: per_step.pop(f"reset.{name}") for name in list(per_step) if f"reset.{name}" in per_step}
    exact = {name: f"extras/{EXACT[name]}" if EXACT[name] in header.extras else name for name in EXACT}
    is_dict = isinstance(header.observation_space, spaces.Dict)
    lengths, seeds = np.asarray(arrays["episodes/length"]), np.asarray(arrays["episodes/seed"])
    first_steps = np.cumsum(lengths) - lengths
    for episode, (n, seed, first) in enumerate(zip(lengths, seeds, first_steps, strict=True)):

        def rows(name: str, first: int = first, n: int = n) -> np.ndarray:
            return arrays[name][first : first + n]

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
        observations = {
            name.removeprefix("observations/"): rows(name, first + episode, n + 1)
            for name in subspaces(header.observation_space, "observations")
        }
        yield EpisodeBuffer(
            id=episode,
            seed=None if seed == -1 else int(seed),
            observations=observations if is_dict else observations["observations"],
            actions=rows(exact["actions"]),
            rewards=rows(exact["rewards"]) if header.rewards else np.zeros(n, np.float32),  # type: ignore[arg-type]
            terminations=rows("terminated"),  # type: ignore[arg-type]
            truncations=rows("truncated"),  # type: ignore[arg-type]
            infos=infos or None,
        )


FORMAT = Format(
    name="Minari",
    description=f"{PREFIX}namespace/name-v0, a folder with data/metadata.json, or a MinariDataset",
    recognizes=recognizes,
    read=read,
    declares_spaces=True,
    extra="minari",
    scheme=Scheme(PREFIX, dataset_folder, pattern=r"([\w-]+/)*[\w-]+-v\d+", download="minari download {name}"),
    write=write,
)
