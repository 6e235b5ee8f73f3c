"""ManiSkill: a group for each trajectory in an HDF5 file, and a JSON file of the same name beside it."""

import json
import re
import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.foreign.base import Foreign, Format, Options
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.foreign.recorded import Episode, chosen, flattened, join_episodes, member, numbered, readable

NAME = "ManiSkill"
TRAJECTORY = re.compile(r"traj_\d+")
# All other arrays of a trajectory, such as simulator states, become extras.
READ = ("obs", "actions", "rewards", "success", "terminated", "truncated")
REPLAY = "python -m mani_skill.trajectory.replay_trajectory --traj-path FILE -o state --save-traj"


def recognizes(probe: Probe) -> bool:
    """
    :param probe: a path or an object
    :return: whether it is an HDF5 file with trajectories
    """
    return probe.hdf5 is not None and any(TRAJECTORY.fullmatch(name) for name in probe.names)


def read(probe: Probe, options: Options) -> Foreign:
    """
    Read trajectories into memory. Nested observations become a Dict: ``agent/qpos`` is the key ``agent_qpos``.

    ``terminated`` and ``truncated`` of the last step say how the episode ended. A file without both (ManiSkill 2) says nothing
    about terminations; there, episodes of ``max_episode_steps`` steps (the option, or the JSON file's) were truncated.

    :param probe: the HDF5 file
    :param options: ``observation_space`` (default: unbounded, 0 to 255 for uint8, of the data's shapes; a Dict with some
        of the keys reads these alone), ``action_space`` (default: [-1, 1]) and ``max_episode_steps``
    :return: the data
    """
    path, file = probe.path, probe.hdf5
    assert file is not None
    information = _read_json(path)
    environment = information.get("env_info") or {}
    metadata = {entry.get("episode_id"): entry for entry in information.get("episodes") or ()}
    names = numbered([name for name in probe.names if TRAJECTORY.fullmatch(name)])
    lacking = {f"traj_{number}" for number in metadata} - set(names)
    if lacking:
        problem = f"is missing, but {path.with_suffix('.json').name} lists it"
        raise DatasetError(path, numbered(list(lacking))[0], problem, "Copy or download the file again")
    limit = options.max_episode_steps or environment.get("max_episode_steps")
    with readable(path):
        episodes = [_episode(file[name], metadata.get(int(name.split("_")[1]), {}), path, options, limit) for name in names]
    kwargs = dict(environment.get("env_kwargs") or {})
    modes = {entry.get("control_mode") for entry in metadata.values()} - {None}
    if len(modes) == 1:
        kwargs.setdefault("control_mode", modes.pop())
    rest = {name: value for name, value in information.items() if name not in ("env_info", "episodes")}
    return join_episodes(
        episodes,
        path,
        options,
        NAME,
        provenance={NAME: {**rest, "env_info": environment}} if information else None,
        env_id=environment.get("env_id") or "",
        env_kwargs=kwargs,
    )


def _read_json(path: Path) -> dict[str, Any]:
    beside = path.with_suffix(".json")
    if not beside.exists():
        warnings.warn(f"{path}: {beside.name} is not beside the file, so that environment, seeds and time limit are unknown.")
        return {}
    try:
        information = json.loads(beside.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DatasetError(beside, "file", f"cannot be read as JSON ({error})", "Copy or download it again") from error
    entries = information.get("episodes", []) if isinstance(information, dict) else None
    environment = information.get("env_info", {}) if isinstance(information, dict) else None
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries) or not isinstance(environment, dict):
        problem = "is not what ManiSkill writes: an object with env_info and a list of episodes"
        raise DatasetError(beside, "episodes", problem, "Copy or download it again")
    return information


def _episode(group: Any, metadata: dict[str, Any], path: Path, options: Options, limit: int | None) -> Episode:
    if not isinstance(group, h5py.Group):
        raise DatasetError(path, group.name.strip("/"), "is an array, expected a group", "Copy or download the file again")
    place = group.name.strip("/") + "/"
    observations = group.get("obs")
    if observations is None or (isinstance(observations, h5py.Group) and not len(flattened(observations))):
        raise DatasetError(
            path, f"{place}obs", "is missing: demonstrations hold simulator states only", f"Replay them: {REPLAY}"
        )
    actions = member(group, "actions", path)[()]
    n = len(actions)
    if metadata.get("elapsed_steps", n) != n:
        problem = f"has {n} rows, but elapsed_steps in {path.with_suffix('.json').name} is {metadata['elapsed_steps']}"
        raise DatasetError(path, f"{place}actions", problem, "Copy or download both files again")
    found = flattened(observations) if isinstance(observations, h5py.Group) else {"": observations}
    rows = {key: array[()] for key, array in chosen(found, options.observation_space, path, f"{place}obs").items()}
    steps = {"actions": actions}
    steps |= {name: member(group, name, path)[()].reshape(-1) for name in ("rewards", "success") if name in group}
    ends = {name: member(group, name, path)[()].reshape(-1).astype(bool) for name in READ[-2:] if name in group}
    extras = {name: flags for name, flags in ends.items() if flags[:-1].any()}
    for name, node in group.items():
        if name not in READ:
            arrays = flattened(node, ".", f"{name}.") if isinstance(node, h5py.Group) else {name: node}
            extras |= {key: array[()] for key, array in arrays.items() if array.ndim}
    for name, flags in ends.items():
        if len(flags) != n:
            problem = f"has {len(flags)} rows, but there are {n} actions"
            raise DatasetError(path, f"{place}{name}", problem, "Copy or download the file again")
    solved = metadata.get("success", (metadata.get("info") or {}).get("success"))
    if "success" not in steps and solved is not None:
        steps["success"] = np.arange(n) == (n - 1 if solved else -1)
    terminated = bool(n and "terminated" in ends and ends["terminated"][-1])
    truncated = bool(n and ends["truncated"][-1]) if "truncated" in ends else not ends and limit is not None and n >= limit
    seed = metadata.get("episode_seed", (metadata.get("reset_kwargs") or {}).get("seed"))
    seed = seed[0] if isinstance(seed, list) and len(seed) == 1 else seed
    return Episode(
        path,
        place,
        rows,
        steps,
        extras,
        terminated=terminated,
        truncated=truncated and not terminated,
        seed=seed if isinstance(seed, int) and seed < 2**63 else -1,
    )


FORMAT = Format(
    name=NAME,
    description="an HDF5 file with the groups traj_0, ... and a JSON file of the same name",
    recognizes=recognizes,
    read=read,
    declares_spaces=False,
)
