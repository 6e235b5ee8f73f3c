"""Numbers that describe a dataset: what the terminal's summary and the page of ``sb3-offline inspect`` both show."""

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_offline.data.reader import DatasetSource
from sb3_offline.data_tools.array_statistics import array_statistics
from sb3_offline.data_tools.dataset_warnings import find_warnings
from sb3_offline.data_tools.example_check import check_examples
from sb3_offline.data_tools.joined_datasets import JoinedDatasets
from sb3_offline.envs import ENV_ID

SATURATED = 0.99
"""An action counts as saturated beyond this share of its bound."""
CELL = 0.02
"""Metres: where the hand goes is counted in cells of this size."""


def inspect_dataset(
    source: DatasetSource | JoinedDatasets, examples: str | os.PathLike | np.ndarray | None = None
) -> dict[str, Any]:
    """
    Summarise a dataset file, or several of one environment together. Images are only sampled; all other arrays are read whole.

    :param source: path, glob pattern, ``OfflineDataset``, or a sequence of these
    :param examples: success examples, in any form that learners take, to be compared with the data
    :return: plain numbers, texts, lists and dicts (JSON); ``warnings`` lists what looks wrong: each has a ``field``, a
        ``problem`` and a ``remedy``
    """
    data = source if isinstance(source, JoinedDatasets) else JoinedDatasets(source)
    arrays = array_statistics(data)
    summary: dict[str, Any] = {
        "files": [
            {"file": str(part.path), "bytes": _size(part.path), "storage": part.storage, "episodes": part.n_episodes}
            for part in data.parts
        ],
        "env_id": data.env_id,
        "env_kwargs": data.env_kwargs,
        "observation_space": str(data.observation_space),
        "action_space": str(data.action_space),
        "n_episodes": data.n_episodes,
        "n_steps": data.n_steps,
        "provenance": data.provenances,
        "arrays": {name: statistics.summary() for name, statistics in arrays.items()},
    }
    if data.n_episodes == 0:
        remedy = "Collect again, or leave the file out"
        return {**summary, "warnings": [{"field": "episodes/length", "problem": "there is no episode", "remedy": remedy}]}
    last = data.step_starts + data.lengths - 1
    summary["lengths"] = _spread(data.lengths)
    summary["terminated"] = int(data.terminated[last].sum())
    summary["truncated"] = int(data.truncated[last].sum())
    summary["groups"] = _groups(data)
    summary["tasks"] = _tasks(data)
    summary["actions"] = _actions(data)
    warnings = find_warnings(data, arrays)
    if examples is not None:
        summary["examples"], more = check_examples(data, examples)
        warnings += more
    summary["warnings"] = [warning._asdict() for warning in warnings]
    return summary


def _size(path: Path) -> int:
    """:return: bytes of a file, or of all files in a folder"""
    return sum(file.stat().st_size for file in ([path] if path.is_file() else path.rglob("*")) if file.is_file())


def _spread(values: np.ndarray) -> dict[str, float]:
    return {name: float(f(values)) for name, f in (("min", np.min), ("mean", np.mean), ("max", np.max), ("std", np.std))}


def _groups(data: JoinedDatasets) -> dict[str, dict[str, Any]]:
    """Success and returns of all episodes, and of each source's."""
    solved, returns = data.solved(), episode_returns(data)
    groups = {}
    for label, inside in data.groups().items():
        group: dict[str, Any] = {"episodes": int(inside.sum()), "steps": int(data.lengths[inside].sum())}
        if data.success is not None and solved is not None and inside.any():
            group["success"] = float(solved[inside].mean())
            group["success_at_end"] = float(data.success[data.step_starts + data.lengths - 1][inside].mean())
        if returns is not None and inside.any():
            group["return"] = _spread(returns[inside])
        groups[label] = group
    return groups


def episode_returns(data: JoinedDatasets) -> np.ndarray | None:
    """
    :return: (E,) float64, undiscounted; without rewards, of the stock rewards of the task that is the episode's source;
        ``None`` where there are neither
    """
    rewards = data.rewards
    tasks = task_names(data)
    if rewards is None and data.source is not None and tasks and set(data.sources) <= set(tasks):
        own = np.array([tasks.index(label) for label in data.sources])[data.source]
        rewards = data.arrays["extras/task_reward"][:][np.arange(data.n_steps), np.repeat(own, data.lengths)]
    if rewards is None or not data.n_episodes:
        return None
    return np.add.reduceat(rewards.astype(np.float64), data.step_starts)


def task_names(data: JoinedDatasets) -> list[str]:
    """:return: the tasks of the columns of ``task_success`` and ``task_reward``; empty where the data have none"""
    if data.env_id != ENV_ID or not {"extras/task_success", "extras/task_reward"} <= data.arrays.keys():
        return []
    try:
        from sb3_offline.envs.multimodal_metaworld.tables import find_table
    except ModuleNotFoundError:  # the extra is not installed, and files do not name their tasks
        return []
    return list(find_table(data.env_kwargs.get("table", "paper")).tasks)


def _tasks(data: JoinedDatasets) -> dict[str, dict[str, dict[str, float]]]:
    """Which tasks the episodes of each source solved, the attempted one or by chance another; and their mean returns."""
    names = task_names(data)
    if not names:
        return {}
    success, rewards = (data.arrays[f"extras/{name}"][:] for name in ("task_success", "task_reward"))
    solved = np.logical_or.reduceat(success, data.step_starts)
    returns = np.add.reduceat(rewards.astype(np.float64), data.step_starts)
    return {
        label: {
            task: {"success": float(solved[inside, column].mean()), "return": float(returns[inside, column].mean())}
            for column, task in enumerate(names)
        }
        for label, inside in data.groups().items()
        if inside.any()
    }


def _actions(data: JoinedDatasets) -> dict[str, Any]:
    space, flat = data.action_space, data.actions.reshape(data.n_steps, -1)
    if not isinstance(space, spaces.Box):
        values, counts = np.unique(flat, axis=0, return_counts=True)
        return {"counts": {str(value): int(count) for value, count in zip(values.tolist(), counts, strict=True)}}
    low, high = space.low.reshape(-1), space.high.reshape(-1)
    with np.errstate(invalid="ignore"):  # what is unbounded is never saturated
        saturated = np.abs(flat - (low + high) / 2) > SATURATED * (high - low) / 2
    return {
        "min": flat.min(axis=0).tolist(),
        "mean": flat.mean(axis=0, dtype=np.float64).tolist(),
        "max": flat.max(axis=0).tolist(),
        "std": flat.std(axis=0, dtype=np.float64).tolist(),
        "saturated": saturated.mean(axis=0).tolist(),
    }


def solved_by(data: JoinedDatasets) -> dict[str, np.ndarray]:
    """:return: label to (longest episode,) share of the episodes that have been solved after so many steps"""
    solved = data.solved()
    if data.success is None or solved is None or not solved.any():
        return {}
    after = np.full(data.n_episodes, np.iinfo(np.int64).max)
    hits = np.flatnonzero(data.success)
    episodes = np.searchsorted(data.step_starts, hits, side="right") - 1
    np.minimum.at(after, episodes, hits - data.step_starts[episodes] + 1)
    moments = np.arange(1, int(data.lengths.max()) + 1)
    groups = data.groups()
    return {
        label: np.searchsorted(np.sort(after[inside]), moments, side="right") / inside.sum()
        for label, inside in groups.items()
        if inside.any()
    }


class Coverage(NamedTuple):
    """
    Where the hand of ``MultimodalMetaworld-v0`` goes, seen from above.

    :param what: which numbers were counted
    :param edges: of the cells in x and in y (m)
    :param counts: label to (x cells, y cells): of all episodes, and of each source's
    :param bodies: mean x and y (m) of the objects
    """

    what: str
    edges: tuple[np.ndarray, np.ndarray]
    counts: dict[str, np.ndarray]
    bodies: dict[str, tuple[float, float]]


def table_coverage(data: JoinedDatasets) -> Coverage | None:
    """:return: ``None`` where the data do not say where the hand is"""
    if data.env_id != ENV_ID or not data.n_episodes:
        return None
    try:
        from sb3_offline.envs.multimodal_metaworld import scene
        from sb3_offline.envs.multimodal_metaworld.tables import find_table
    except ModuleNotFoundError:
        return None
    table = find_table(data.env_kwargs.get("table", "paper"))
    states, seen = data.arrays.get("extras/scene_state"), data.arrays.get("observations")
    if seen is not None and seen.shape[1:] == (len(table.state_names),):
        what, lengths = "hand_x and hand_y of the observations", data.lengths + 1
        hand = seen[:][:, [table.state_names.index("hand_x"), table.state_names.index("hand_y")]]
    elif states is not None:
        what, lengths = "the hand's target in scene_state", data.lengths
        hand = states[:][:, table.scene_state["hand_target"]]
    else:
        return None
    x, y = hand[:, :2].astype(np.float64).T
    low, high = scene.MOCAP_LOW[:2], scene.MOCAP_HIGH[:2]
    x_edges, y_edges = (np.arange(np.floor(a / CELL), np.ceil(b / CELL) + 1) * CELL for a, b in zip(low, high, strict=True))
    counts = {
        label: np.histogram2d(x[np.repeat(inside, lengths)], y[np.repeat(inside, lengths)], bins=[x_edges, y_edges])[0]
        for label, inside in data.groups().items()
        if inside.any()
    }
    bodies: dict[str, tuple[float, float]] = {}
    if states is not None:
        some = states[np.linspace(0, len(states) - 1, min(len(states), 500)).astype(int)]
        means = some[:, table.scene_state["bodies"]].mean(axis=0).reshape(-1, 2)
        bodies = {name: (float(a), float(b)) for name, (a, b) in zip(table.positions, means, strict=True)}
    return Coverage(what, (x_edges, y_edges), counts, bodies)


def action_histograms(data: JoinedDatasets, bins: int = 41) -> list[tuple[np.ndarray, np.ndarray]]:
    """:return: of each dimension of a Box of actions (counts, edges); what is out of bounds counts at the bound"""
    if not isinstance(data.action_space, spaces.Box):
        return []
    flat = data.actions.reshape(data.n_steps, -1)
    ends = zip(data.action_space.low.reshape(-1), data.action_space.high.reshape(-1), strict=True)
    histograms = []
    for column, (low, high) in zip(flat.T, ends, strict=True):
        low, high = (low, high) if np.isfinite([low, high]).all() else (column.min(), column.max())
        histograms.append(np.histogram(np.clip(column, low, high), bins, (float(low), float(high))))
    return histograms
