"""Rollouts of the `imitation` library: ``.npz`` files, and the folders of HuggingFace's `datasets` that it writes now."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.foreign.base import Foreign, Format, Options
from sb3_offline.data.foreign.episodes import checked_observations, guess_action_space, guess_observation_space
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.format import Header
from sb3_offline.data.spaces import check_rows

REQUIRED = ("obs", "acts", "terminal", "indices")
# Columns of a folder; the indices follow from their lengths
COLUMNS = ("obs", "acts", "terminal", "infos")
TIME_LIMIT = "TimeLimit.truncated"


def recognizes(probe: Probe) -> bool:
    """
    :param probe: a path or an object
    :return: whether it is an ``.npz`` file with the arrays of rollouts, or a folder of `datasets` with their columns
    """
    if probe.kind == "folder":
        information = probe.json("dataset_info.json") if "state.json" in probe.names else None
        return isinstance(information, dict) and set(COLUMNS) <= set(information.get("features") or ())
    return probe.kind == "zip" and probe.names.issuperset(REQUIRED)


def read(probe: Probe, options: Options) -> Foreign:
    """
    Read rollouts into memory.

    Rollouts call every end of an episode ``terminal``, also an end by a time limit. The infos of a folder say which ends these
    were. The infos of an ``.npz`` file are pickled and therefore not read.

    :param probe: the file or the folder
    :param options: ``observation_space`` (default: unbounded, 0 to 255 for uint8, of the data's shape), ``action_space``
        (default: [-1, 1]), and ``max_episode_steps``: episodes of that length were truncated
    :return: the data
    """
    path = probe.path
    raw = _read_folder(path) if probe.kind == "folder" else _read_npz(path)
    n = len(raw["acts"])
    ends = np.append(raw["indices"], n).astype(np.int64)  # the end of the last episode is not among the indices
    lengths = np.diff(ends, prepend=0)
    for name, rows in (("obs", n + len(ends)), ("terminal", len(ends)), ("rews", n)):
        if name in raw and len(raw[name]) != rows:
            problem = f"has {len(raw[name])} rows, expected {rows} for {n} actions in {len(ends)} episodes"
            raise DatasetError(path, name, problem, "Write the rollouts again with imitation")
    if lengths.min() < 1:
        raise DatasetError(path, "indices", "holds an episode without a step", "Leave it out")
    header = Header(
        options.observation_space or guess_observation_space(raw["obs"]),
        options.action_space or guess_action_space(raw["acts"], path),
        provenance={"format": "imitation"},
        rewards="rews" in raw,
        success=False,
    )
    ended = raw["terminal"].astype(bool)
    limit = options.max_episode_steps
    timed_out = ended & (lengths == limit) if limit else np.zeros(len(ends), dtype=bool)
    if "timed_out" in raw:
        timed_out |= ended & raw["timed_out"]
    steps = {"actions": raw["acts"], "terminated": np.zeros(n, dtype=bool), "truncated": np.zeros(n, dtype=bool)}
    steps["terminated"][ends - 1], steps["truncated"][ends - 1] = ended & ~timed_out, timed_out
    if "rews" in raw:
        steps["rewards"] = raw["rews"]
    arrays: dict[str, Any] = {"episodes/length": lengths, "episodes/seed": np.full(len(ends), -1, dtype=np.int64)}
    arrays |= checked_observations({"observations": raw["obs"]}, header.observation_space, path)
    fields = header.fields()
    for name, array in steps.items():
        arrays[name] = check_rows(array, fields[name].shape, fields[name].dtype, None, path, name)
    return Foreign(header, arrays)


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in (*REQUIRED, "rews") if name in file.files}
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise DatasetError(path, "file", f"cannot be read ({error})", "Write the rollouts again with imitation") from error


def _read_folder(path: Path) -> dict[str, np.ndarray]:
    import pyarrow

    try:
        with open(path / "state.json") as file:
            names = [part["filename"] for part in json.load(file)["_data_files"]]
        tables = [pyarrow.ipc.open_stream(pyarrow.memory_map(str(path / name))).read_all() for name in names]
        table = pyarrow.concat_tables(tables)
        raw = {"terminal": table["terminal"].to_numpy(), "indices": np.cumsum([len(acts) for acts in table["acts"]])[:-1]}
        for name in {"obs", "acts", "rews"} & set(table.column_names):
            kind = table[name].type
            while hasattr(kind, "value_type"):
                kind = kind.value_type
            raw[name] = np.concatenate([np.asarray(rows, kind.to_pandas_dtype()) for rows in table[name].to_pylist()])
        last = [json.loads(infos[-1]) if infos else {} for infos in table["infos"].to_pylist()]
    except (OSError, KeyError, ValueError, pyarrow.ArrowInvalid) as error:
        problem = f"cannot be read as rollouts of imitation ({type(error).__name__}: {error})"
        raise DatasetError(path, "folder", problem, "Write it again with imitation.data.serialize.save") from error
    raw["timed_out"] = np.array([info.get(TIME_LIMIT, False) is True for info in last], dtype=bool)
    return raw


FORMAT = Format(
    name="imitation",
    description=f"rollouts: an .npz file with {', '.join(REQUIRED)}, or a folder of datasets with {', '.join(COLUMNS)}",
    recognizes=recognizes,
    read=read,
    declares_spaces=False,
    extra="imitation",
)
