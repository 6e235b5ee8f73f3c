"""Rollouts of the `imitation` library: its ``.npz`` files, and the folders of HuggingFace's `datasets` that it writes now."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.flat import checked_observations, guess_action_space, guess_observation_space
from sb3_offline.data.format import Header
from sb3_offline.data.spaces import check_rows

REQUIRED = ("obs", "acts", "terminal", "indices")
TIME_LIMIT = "TimeLimit.truncated"


def read_imitation(
    path: Path,
    observation_space: spaces.Space | None = None,
    action_space: spaces.Space | None = None,
    max_episode_steps: int | None = None,
) -> tuple[Header, dict[str, Any]]:
    """
    Read rollouts of `imitation` into memory, as the arrays of our format.

    Such rollouts call every end of an episode ``terminal``, one by a time limit too. Folders say in their infos which ones
    these were; infos of an ``.npz`` are pickled, and not looked at.

    :param path: ``.npz``, or folder
    :param observation_space: default: unbounded (0 to 255 for uint8), with the shape of the data
    :param action_space: default: [-1, 1] with the shape of the data
    :param max_episode_steps: the environment's time limit: episodes of that length were truncated
    :return: header and arrays by name, as ``Header.fields`` names them
    """
    raw = _read_folder(path) if path.is_dir() else _read_npz(path)
    n = len(raw["acts"])
    ends = np.append(raw["indices"], n).astype(np.int64)  # the last episode's end is not among the indices
    lengths = np.diff(ends, prepend=0)
    for name, rows in (("obs", n + len(ends)), ("terminal", len(ends)), ("rews", n)):
        if name in raw and len(raw[name]) != rows:
            problem = f"has {len(raw[name])} rows, expected {rows} for {n} actions in {len(ends)} episodes"
            raise DatasetError(path, name, problem, "Write the rollouts again with imitation")
    if lengths.min() < 1:
        raise DatasetError(path, "indices", "holds an episode without a step", "Leave it out")
    header = Header(
        observation_space or guess_observation_space(raw["obs"]),
        action_space or guess_action_space(raw["acts"], path),
        provenance={"format": "imitation"},
        rewards="rews" in raw,
        success=False,
    )
    ended = raw["terminal"].astype(bool)
    timed_out = ended & (lengths == max_episode_steps) if max_episode_steps else np.zeros(len(ends), dtype=bool)
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
    return header, arrays


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            raw = {name: file[name] for name in (*REQUIRED, "rews") if name in file.files}
    except FileNotFoundError as error:
        raise DatasetError(path, "file", "does not exist", "Check the path") from error
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise DatasetError(path, "file", f"cannot be read ({error})", "Write the rollouts again with imitation") from error
    for name in REQUIRED:
        if name not in raw:
            remedy = "As a dataset, .npz files are those of imitation's rollouts; write others with DatasetWriter"
            raise DatasetError(path, name, "is missing", remedy)
    return raw


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
        problem = f"is no folder of imitation's rollouts ({type(error).__name__}: {error})"
        raise DatasetError(path, "folder", problem, "Give what imitation.data.serialize.save wrote") from error
    raw["timed_out"] = np.array([info.get(TIME_LIMIT, False) is True for info in last], dtype=bool)
    return raw
