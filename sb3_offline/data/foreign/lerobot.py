"""LeRobot datasets, versions 2.0, 2.1 and 3.0: folders of Parquet tables and videos."""

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.foreign.base import Foreign, Format, Options
from sb3_offline.data.foreign.episodes import cut_episodes, guess_action_space, guess_observation_space
from sb3_offline.data.foreign.lerobot_images import Clip, DecodedImages, VideoDecoder, decode_encoded, warn_if_large
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.format import Header
from sb3_offline.data.spaces import check_observations, subspaces

INFO = "meta/info.json"
METADATA = ("info.json", "episodes.jsonl", "episodes", "tasks.jsonl", "tasks.parquet")
OLD_INFO = "meta_data/info.json"  # of versions 1.x
PATHS = {
    "v2": {
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    },
    "v3": {
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    },
}
INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")
FLAGS = ("next.done", "next.success", "next.terminated", "next.truncated")
LABELS = ("next.reward", *FLAGS)
DOWNLOAD = "Download the dataset again, completely"


class Table(NamedTuple):
    """
    A dataset, its rows in the order of the episodes.

    :param root: the folder
    :param info: contents of ``meta/info.json``
    :param version: "v2" or "v3"
    :param episodes: metadata of each episode
    :param columns: pyarrow's columns by name, with one row for each frame
    :param lengths: (E,) number of frames of each episode
    """

    root: Path
    info: dict[str, Any]
    version: str
    episodes: list[dict[str, Any]]
    columns: dict[str, Any]
    lengths: np.ndarray


def recognizes(probe: Probe) -> bool:
    """
    :param probe: a path or an object
    :return: whether it is a folder with LeRobot's metadata, of which some may be missing
    """
    if probe.kind != "folder":
        return False
    if "meta_data" in probe.names:
        return isinstance(probe.json(OLD_INFO), dict)
    return "meta" in probe.names and any((probe.path / "meta" / name).exists() for name in METADATA)


def read(probe: Probe, options: Options) -> Foreign:
    """
    Read a LeRobot dataset: numbers into memory, images as arrays that are decoded when they are read.

    The keys that begin with "observation." become the observations: a Dict with the rest of the keys ("." becomes "_"), or a
    plain array if there is only one. Tasks become sources. The numbers of other columns become extras.

    LeRobot has one row for each step and no observation after the last step, see
    :func:`~sb3_offline.data.foreign.episodes.cut_episodes`. An episode terminated if its last row has ``next.terminated``, or
    else ``next.success``, or else ``next.done`` in episodes that are shorter than ``max_episode_steps``. Otherwise it was
    truncated.

    :param probe: the folder
    :param options: ``observation_space`` (default: unbounded, 0 to 255 for images; a Dict of some of the keys leaves out the
        others), ``action_space`` (default: [-1, 1]) and ``max_episode_steps``
    :return: the data
    """
    import pyarrow  # noqa: F401  (the extra is missing, not the data)

    table = _read_tables(probe)
    root, features = table.root, table.info["features"]
    n = int(table.lengths.sum())
    if "action" not in features:
        similar = [name for name in features if name.startswith("action")]
        problem = "is missing" + (f", but there are {', '.join(similar)}" if similar else "")
        raise DatasetError(root / INFO, "features: action", problem, "Write one feature of that name with LeRobot")
    actions = _numbers(table, "action")
    keys = _observation_keys(table, options.observation_space)
    vectors = {key: _numbers(table, name) for key, name in keys.items() if not _is_image(features[name])}
    shapes = {key: _image_shape(table, name) for key, name in keys.items() if _is_image(features[name])}
    space = options.observation_space or _space(vectors, shapes)
    action_space = options.action_space or guess_action_space(actions, root, "LeRobot", "action")
    if action_space.shape == () and actions.shape == (n, 1):
        actions = actions[:, 0]
    steps: dict[str, np.ndarray] = {"actions": actions}
    ends = np.zeros(n, dtype=bool)
    ends[np.cumsum(table.lengths) - 1] = True
    steps |= _labels(table, ends, options)
    steps["truncated"] = ends & ~steps["terminated"]
    extras = _extras(table, set(keys.values()))
    sources, labels = _sources(table)
    header = Header(
        space,
        action_space,
        provenance={
            "format": f"LeRobot {table.info.get('codebase_version', table.version)}",
            "robot_type": table.info.get("robot_type"),
            "fps": table.info.get("fps"),
            "keys": keys,
        },
        sources=sources,
        rewards="rewards" in steps,
        success="success" in steps,
        extras={name: (array.shape[1:], array.dtype) for name, array in extras.items()},
    )
    # The rows of the table, in place of the observations, are cut first: images are decoded later
    numbered = Header(spaces.Box(0, n, (), np.int64), action_space, rewards=header.rewards, success=header.success)
    numbered.extras = {**header.extras, "row": ((), np.int64), "episode": ((), np.int64)}
    steps |= {f"extras/{name}": array for name, array in extras.items()}
    steps |= {"extras/row": np.arange(n), "extras/episode": np.repeat(np.arange(len(table.lengths)), table.lengths)}
    arrays = cut_episodes(
        numbered,
        root,
        observations={"observations": np.arange(n)},
        next_observations=None,
        known=np.zeros(n, dtype=bool),
        ends=ends,
        steps=steps,
    )
    rows, owners = arrays.pop("observations"), arrays.pop("extras/episode")
    arrays.pop("extras/row")
    if sources is not None:
        first_steps = np.cumsum(arrays["episodes/length"]) - arrays["episodes/length"]
        arrays["episodes/source"] = labels[owners[first_steps]].astype(np.int16)
    arrays |= _observations(table, space, keys, rows, vectors, shapes)
    return Foreign(header, arrays)


# ------------------------------------------------------------------ tables


def _read_tables(probe: Probe) -> Table:
    """:return: the tables of all episodes, checked against the metadata"""
    root, info = probe.path, probe.json(INFO)
    described = info or probe.json(OLD_INFO)
    if not isinstance(described, dict):
        raise DatasetError(root / INFO, "file", "is missing from this LeRobot dataset, or is no JSON", DOWNLOAD)
    version = str(described.get("codebase_version", "v3.0"))
    major = version.split(".")[0] if version.startswith("v") else f"v{version.split('.')[0]}"
    if info is None or major not in PATHS:
        problem = f"is {version}, and LeRobot's versions 2.0, 2.1 and 3.0 can be read"
        remedy = "Convert it with LeRobot's own converter (lerobot/datasets/v30, or v2 for versions 1.x)"
        raise DatasetError(root / (INFO if info else OLD_INFO), "codebase_version", problem, remedy)
    if not isinstance(info.get("features"), dict):
        raise DatasetError(root / INFO, "features", "are missing, so that this is no LeRobot dataset", DOWNLOAD)
    episodes = _episodes(root, major)
    total = info.get("total_episodes", len(episodes))
    if not episodes or len(episodes) != total:
        problem = f"is {total}, but the metadata of LeRobot's episodes describe {len(episodes)}"
        raise DatasetError(root / INFO, "total_episodes", problem, DOWNLOAD)
    chunk_size = int(info.get("chunks_size") or 1000)
    for episode in episodes:
        episode.setdefault("episode_chunk", episode["episode_index"] // chunk_size)
    template = info.get("data_path") or PATHS[major]["data_path"]
    paths = dict.fromkeys(root / _file_name(template, episode, "data", root) for episode in episodes)
    tables = [_read_parquet(path, list(info["features"])) for path in paths]
    import pyarrow as pa

    try:
        whole = pa.concat_tables(tables, promote_options="permissive")
        for name in ("episode_index", "frame_index"):
            if name in whole.column_names and whole[name].null_count:
                raise DatasetError(root / "data", name, "is missing in some of LeRobot's tables", DOWNLOAD)
        owners = whole["episode_index"].to_numpy()
    except (pa.ArrowException, KeyError) as error:
        raise DatasetError(root, "data", f"are no tables of one LeRobot dataset ({error})", DOWNLOAD) from error
    frames = whole["frame_index"].to_numpy() if "frame_index" in whole.column_names else np.arange(len(owners))
    wanted = [episode["episode_index"] for episode in episodes]
    if len(set(wanted)) < len(wanted):
        raise DatasetError(root, "episode_index", "names an episode twice in the metadata", DOWNLOAD)
    places = np.full(max(*wanted, *owners.tolist(), 0) + 1, -1)
    places[wanted] = np.arange(len(wanted))
    order = np.lexsort((frames, places[owners]))
    order = order[places[owners][order] >= 0]
    lengths = np.bincount(places[owners][order], minlength=len(wanted))
    for episode, length in zip(episodes, lengths.tolist(), strict=True):
        if length == 0 or length != episode.get("length", length):
            problem = f"has {length} rows in the tables, but LeRobot's metadata say {episode.get('length', 'that it exists')}"
            raise DatasetError(root, f"episode {episode['episode_index']}", problem, DOWNLOAD)
    whole = whole.take(order).combine_chunks()
    columns = {name: whole[name] for name in whole.column_names}
    return Table(root, info, major, episodes, columns, lengths)


def _episodes(root: Path, version: str) -> list[dict[str, Any]]:
    """:return: metadata of each episode"""
    if version == "v2":
        episodes = _read_lines(root / "meta" / "episodes.jsonl")
    else:
        folder = root / "meta" / "episodes"
        paths = sorted(folder.glob("**/*.parquet"))
        if not paths:
            raise DatasetError(folder, "episodes", "are missing from this LeRobot dataset", DOWNLOAD)
        episodes = [row for path in paths for row in _read_parquet(path, None).to_pylist()]
    for episode in episodes:
        if not isinstance(episode, dict) or not isinstance(episode.get("episode_index"), int):
            raise DatasetError(root / "meta", "episode_index", "is missing from the metadata of an episode", DOWNLOAD)
    return sorted(episodes, key=lambda episode: episode["episode_index"])


def _read_lines(path: Path) -> list[dict[str, Any]]:
    try:
        with open(path, encoding="utf-8") as file:
            return [json.loads(line) for line in file if line.strip()]
    except FileNotFoundError as error:
        raise DatasetError(path, "file", "is missing from this LeRobot dataset", DOWNLOAD) from error
    except (OSError, ValueError) as error:
        raise DatasetError(path, "file", f"is no JSON lines ({error})", DOWNLOAD) from error


def _read_parquet(path: Path, features: list[str] | None) -> Any:
    """:return: the table; without the statistics of single episodes, and with those columns alone that are features"""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not path.is_file():
        raise DatasetError(path, "file", "is missing from this LeRobot dataset", DOWNLOAD)
    try:
        with pq.ParquetFile(path) as file:
            names = file.schema_arrow.names
            if features is None:
                return file.read([name for name in names if not name.startswith("stats/")])
            return file.read([name for name in names if name in features or name in INDICES])
    except (pa.ArrowException, OSError, ValueError) as error:
        raise DatasetError(path, "file", f"is no Parquet table ({error})", DOWNLOAD) from error


def _file_name(template: str, episode: Mapping[str, Any], kind: str, root: Path, **more: Any) -> str:
    """:return: path of a file, relative to the root; ``kind`` is what the file's indices are listed under in version 3"""
    values = {name: episode[f"{kind}/{name}"] for name in ("chunk_index", "file_index") if f"{kind}/{name}" in episode}
    try:
        return template.format(**{**episode, **values, **more})
    except (KeyError, IndexError, ValueError, TypeError) as error:
        problem = f"names {template!r}, which LeRobot's metadata of episode {episode['episode_index']} do not fill ({error})"
        raise DatasetError(root / INFO, f"path of {kind}", problem, DOWNLOAD) from error


def _numbers(table: Table, name: str) -> np.ndarray:
    """:return: (n, *shape) a column of numbers, of the shape that its feature declares"""
    import pyarrow as pa
    import pyarrow.compute as pc

    shape = tuple(table.info["features"].get(name, {}).get("shape") or ())
    if name not in table.columns:
        problem = "is missing from the tables, but info.json declares it"
        raise DatasetError(table.root / "data", name, problem, "Download the dataset again, or remove the feature")
    column = table.columns[name].combine_chunks()
    column = pa.chunked_array([column]).combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    n = len(column)
    if isinstance(column, pa.ExtensionArray):
        column = column.storage
    try:
        while pa.types.is_list(column.type) or pa.types.is_large_list(column.type) or pa.types.is_fixed_size_list(column.type):
            sizes = pc.min_max(pc.list_value_length(column)).as_py()
            if column.null_count or sizes["min"] != sizes["max"]:
                problem = f"has rows of different lengths, of {sizes['min']} to {sizes['max']} values"
                raise DatasetError(table.root / "data", name, problem, "Leave those episodes out")
            column = column.flatten()
        if column.null_count:
            raise DatasetError(table.root / "data", name, "has rows without a value", "Leave those episodes out")
        values = column.to_numpy(zero_copy_only=False)
    except pa.ArrowException as error:
        raise DatasetError(table.root / "data", name, f"holds no numbers ({error})", DOWNLOAD) from error
    if values.dtype.kind not in "biuf":
        raise DatasetError(table.root / "data", name, f"holds {values.dtype} in place of numbers", DOWNLOAD)
    if values.size != n * int(np.prod(shape)):
        problem = f"has {values.size // max(n, 1)} values in a row, but info.json declares the shape {shape}"
        raise DatasetError(table.root / "data", name, problem, "Correct the shape in meta/info.json")
    return values.reshape(n, *shape)


# ------------------------------------------------- labels, tasks and extras


def _labels(table: Table, ends: np.ndarray, options: Options) -> dict[str, np.ndarray]:
    """:return: terminations, and rewards and success where the dataset has them"""
    flags = {name: _flags(table, name) for name in FLAGS if name in table.info["features"]}
    labels: dict[str, np.ndarray] = {}
    if "next.reward" in table.info["features"]:
        labels["rewards"] = _numbers(table, "next.reward").reshape(len(ends))
    if "next.success" in flags:
        labels["success"] = flags["next.success"]
    limit = options.max_episode_steps
    at_limit = ends & np.repeat(table.lengths == limit, table.lengths) if limit else np.zeros_like(ends)
    if "next.terminated" in flags:
        terminated = flags["next.terminated"]
    elif "next.success" in flags:
        terminated = flags["next.success"]
    elif "next.done" in flags:
        terminated = flags["next.done"] & ~at_limit
        if not limit and terminated[ends].any():
            warnings.warn(
                f"{table.root}: next.done: does not tell terminations from time limits. All ends that it marks are taken for "
                "terminations. If a time limit ended some episodes, give it: OfflineDataset(path, max_episode_steps=...)."
            )
    else:
        terminated = np.zeros_like(ends)
    labels["terminated"] = terminated & ends
    return labels


def _flags(table: Table, name: str) -> np.ndarray:
    array = _numbers(table, name)
    if array.size != len(array) or not np.isin(array, (0, 1)).all():
        raise DatasetError(table.root / "data", name, "holds values other than true and false", "Write it as one bool a row")
    return array.reshape(len(array)).astype(bool)


def _extras(table: Table, used: set[str]) -> dict[str, np.ndarray]:
    """:return: the numbers in other columns, by name"""
    others = set(table.info["features"]) - used - {"action", *LABELS, *INDICES}
    numeric = {
        name for name in others & table.columns.keys() if table.info["features"][name].get("dtype", "") not in ("string", "")
    }
    extras = {}
    for name in sorted(name for name in numeric if not _is_image(table.info["features"][name])):
        if name.startswith("observation"):
            continue  # left out on purpose, or with a warning
        extras[name.replace("/", ".")] = _numbers(table, name)
    return extras


def _sources(table: Table) -> tuple[list[str] | None, np.ndarray]:
    """:return: all tasks, and for each episode the index of its first step's task"""
    root = table.root
    if table.version == "v2":
        path = root / "meta" / "tasks.jsonl"
        rows = _read_lines(path) if path.is_file() else []
    else:
        path = root / "meta" / "tasks.parquet"
        rows = _read_parquet(path, None).to_pylist() if path.is_file() else []
    first_rows = np.cumsum(table.lengths) - table.lengths
    if not rows or "task_index" not in table.columns:
        named = [(episode.get("tasks") or [""])[0] for episode in table.episodes]
        tasks = list(dict.fromkeys(named))
        return (tasks, np.array([tasks.index(task) for task in named])) if any(tasks) else (None, np.zeros(0))
    texts: dict[int, str] = {
        row.get("task_index", -1): next((v for v in row.values() if isinstance(v, str)), "") for row in rows
    }
    indices = table.columns["task_index"].to_numpy()
    unknown = set(np.unique(indices).tolist()) - texts.keys()
    if unknown:
        raise DatasetError(path, "task_index", f"has no {min(unknown)}, which rows of LeRobot's tables name", DOWNLOAD)
    if (np.minimum.reduceat(indices, first_rows) != np.maximum.reduceat(indices, first_rows)).any():
        warnings.warn(f"{root}: task_index: changes within an episode. Its source is the task of its first step.")
    places = {index: place for place, index in enumerate(sorted(texts))}
    return [texts[index] for index in sorted(texts)], np.array([places[index] for index in indices[first_rows].tolist()])


# ------------------------------------------------------------ observations


def _is_image(feature: Mapping[str, Any]) -> bool:
    return feature.get("dtype") in ("video", "image")


def _is_depth(feature: Mapping[str, Any]) -> bool:
    info = {**(feature.get("info") or {}), **(feature.get("video_info") or {}), **feature}
    return any(info.get(name) is True for name in ("video.is_depth_map", "is_depth_map"))


def _observation_keys(table: Table, space: spaces.Space | None) -> dict[str, str]:
    """:return: names of features by the keys that they get as observations. The key is "" if there is only one"""
    features, keys = table.info["features"], {}
    for name in features:
        if name != "observation" and not name.startswith("observation."):
            continue
        if features[name].get("dtype") == "string" or _is_depth(features[name]):
            kind = "depth images, which" if _is_depth(features[name]) else "texts, which"
            warnings.warn(f"{table.root}: {name}: holds {kind} observations cannot hold here; it is left out.")
            continue
        # PyTorch, and thus SB3's policies for Dict observations, take no "." in a key, and HDF5 no "/"
        key = name.removeprefix("observation").removeprefix(".").replace(".", "_").replace("/", "_") or "observation"
        while key in keys:
            key += "_"
        keys[key] = name
    wanted = set(space.spaces) if isinstance(space, spaces.Dict) else None
    if wanted is not None and wanted <= keys.keys() and wanted:
        return {key: keys[key] for key in space.spaces}  # type: ignore[union-attr]
    if wanted is not None or (space is not None and len(keys) != 1) or not keys:
        problem = f"give the keys {sorted(keys)}" + (f", but the observation space is {space}" if space is not None else "")
        remedy = "Give an observation_space that is a Dict of some of these keys" if keys else "Give data with observations"
        raise DatasetError(table.root / INFO, "features observation.*", problem, remedy)
    return keys if len(keys) > 1 else {"": next(iter(keys.values()))}


def _image_shape(table: Table, name: str) -> tuple[int, ...]:
    """:return: (height, width, channels) of the images of a camera"""
    feature = table.info["features"][name]
    shape, names = tuple(feature.get("shape") or ()), feature.get("names")
    if isinstance(names, dict):
        names = next((value for value in names.values() if isinstance(value, list)), None)
    if len(shape) == 2:
        shape, names = (*shape, 1), None
    if isinstance(names, list) and len(names) == len(shape) == 3:
        order = [next((i for i, axis in enumerate(names) if str(axis).startswith(first)), -1) for first in "hwc"]
        shape = tuple(shape[i] for i in order) if -1 not in order else shape
    elif len(shape) == 3 and shape[0] in (1, 3) and shape[2] not in (1, 3):
        shape = (*shape[1:], shape[0])
    if len(shape) != 3 or shape[2] not in (1, 3):
        problem = f"declares images of shape {feature.get('shape')}, expected height, width and 1 or 3 channels"
        remedy = "Leave the camera out: OfflineDataset(path, observation_space=spaces.Dict(...)) without its key"
        raise DatasetError(table.root / INFO, f"features: {name}", problem, remedy)
    return shape


def _space(vectors: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]]) -> spaces.Space:
    parts: dict[str, spaces.Space] = {key: spaces.Box(0, 255, shape, np.uint8) for key, shape in shapes.items()}
    parts |= {key: guess_observation_space(array) for key, array in vectors.items()}
    return parts[""] if "" in parts else spaces.Dict(parts)


def _observations(
    table: Table,
    space: spaces.Space,
    keys: Mapping[str, str],
    rows: np.ndarray,
    vectors: Mapping[str, np.ndarray],
    shapes: Mapping[str, tuple[int, ...]],
) -> dict[str, Any]:
    """:return: the observations by array name: vectors in memory, images to be decoded"""
    arrays: dict[str, Any] = {}
    parts = subspaces(space, "observations")
    for key in keys:
        name = f"observations/{key}" if key else "observations"
        declared = parts[name]
        if key in vectors:
            arrays |= check_observations(vectors[key][rows], declared, None, table.root, name)
            continue
        if tuple(declared.shape or ()) != shapes[key] or declared.dtype != np.uint8:
            problem = f"holds images of shape {shapes[key]} and dtype uint8, but the observation space declares {declared}"
            raise DatasetError(table.root / INFO, f"features: {keys[key]}", problem, "Declare the space that they have")
        arrays[name] = _images(table, keys[key], rows, shapes[key])
    warn_if_large(sum(len(rows) * int(np.prod(shape)) for shape in shapes.values()), table.root)
    return arrays


def _images(table: Table, name: str, rows: np.ndarray, shape: tuple[int, ...]) -> DecodedImages:
    if table.info["features"][name]["dtype"] == "image":
        if name not in table.columns:
            raise DatasetError(table.root / "data", name, "is missing from the tables, but info.json declares it", DOWNLOAD)
        return DecodedImages(rows, shape, decode_encoded(table.columns[name], shape, table.root, name), table.root)
    import av  # noqa: F401  (the extra is missing, not the data)

    template = table.info.get("video_path") or PATHS[table.version]["video_path"]
    fps = float(table.info.get("fps") or 0)
    first_rows = np.cumsum(table.lengths) - table.lengths
    if "timestamp" in table.columns:
        times = _numbers(table, "timestamp").reshape(-1).astype(np.float64)
    elif fps:
        times = (np.arange(len(table.columns["episode_index"])) - np.repeat(first_rows, table.lengths)) / fps
    else:
        raise DatasetError(table.root / INFO, "fps", "is missing, and so are LeRobot's timestamps", DOWNLOAD)
    clips = []
    for episode, first, length in zip(table.episodes, first_rows.tolist(), table.lengths.tolist(), strict=True):
        path = table.root / _file_name(template, episode, f"videos/{name}", table.root, video_key=name)
        if not path.is_file():
            remedy = f"{DOWNLOAD}, or leave the camera out: OfflineDataset(path, observation_space=spaces.Dict(...))"
            raise DatasetError(path, name, "is missing from this LeRobot dataset", remedy)
        start = float(episode.get(f"videos/{name}/from_timestamp") or 0)
        clips.append(Clip(path, first, start + times[first : first + length]))
    return DecodedImages(rows, shape, VideoDecoder(clips, shape, 0.5 / fps if fps else 0.02, name), table.root)


FORMAT = Format(
    name="LeRobot",
    description="a folder with meta/info.json, data/*.parquet and videos/*.mp4",
    recognizes=recognizes,
    read=read,
    declares_spaces=False,
    extra="lerobot",
)
