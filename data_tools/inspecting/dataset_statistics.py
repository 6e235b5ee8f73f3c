"""Numbers that describe a dataset. Both the text and the page of ``sb3-offline inspect`` show them."""

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_offline.data.reader import DatasetLike
from sb3_offline.data_tools.inspecting.array_statistics import array_statistics
from sb3_offline.data_tools.inspecting.dataset_warnings import find_warnings
from sb3_offline.data_tools.inspecting.env_check import check_environment
from sb3_offline.data_tools.inspecting.example_check import check_examples
from sb3_offline.data_tools.inspecting.joined_datasets import JoinedDatasets
from sb3_offline.envs import ENV_ID

SATURATED = 0.99
"""An action counts as saturated if its distance from the centre exceeds this share of the distance to the bound."""
CELL_SIZE = 0.02
"""Size in metres of the cells in which positions of the hand are counted."""


def inspect_dataset(
    source: DatasetLike | JoinedDatasets, examples: str | os.PathLike | np.ndarray | None = None, env: Any = None
) -> dict[str, Any]:
    """
    Summarise one dataset file, or several files of one environment together. Images are sampled; all other arrays are read
    whole.

    :param source: path, glob pattern, ``OfflineDataset``, or a sequence of these
    :param examples: success examples to compare with the data, in any form that learners take
    :param env: an environment to compare the spaces with
    :return: JSON types: numbers, texts, lists and dicts. ``warnings`` lists likely mistakes, each with a ``field``, a
        ``problem`` and a ``remedy``.
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
    if env is not None:
        warnings += check_environment(data, env)
    summary["warnings"] = [warning._asdict() for warning in warnings]
    return summary


def _size(path: Path) -> int:
    """:return: size of a file, or of all files in a folder, in bytes"""
    return sum(file.stat().st_size for file in ([path] if path.is_file() else path.rglob("*")) if file.is_file())


def _spread(values: np.ndarray) -> dict[str, float]:
    return {name: float(f(values)) for name, f in (("min", np.min), ("mean", np.mean), ("max", np.max), ("std", np.std))}


def _groups(data: JoinedDatasets) -> dict[str, dict[str, Any]]:
    """:return: success and returns of all episodes, and of the episodes of each source"""
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
    :param data: the dataset
    :return: (E,) float64, undiscounted returns. If the data hold no rewards, they are sums of the stock rewards of the task
        that is the episode's source; ``None`` if there are no such rewards either.
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
    """
    :param data: the dataset
    :return: the tasks of the columns of ``task_success`` and ``task_reward``; empty if the data have no such columns
    """
    if data.env_id != ENV_ID or not {"extras/task_success", "extras/task_reward"} <= data.arrays.keys():
        return []
    try:
        from sb3_offline.envs.multimodal_metaworld.tables import find_table
    except ModuleNotFoundError:  # the extra is not installed, and files do not name their tasks
        return []
    return list(find_table(data.env_kwargs.get("table", "paper")).tasks)


def _tasks(data: JoinedDatasets) -> dict[str, dict[str, dict[str, float]]]:
    """:return: by source, how many of its episodes solved each task, attempted or not, and the mean returns"""
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
    with np.errstate(invalid="ignore"):  # an unbounded action is never saturated
        saturated = np.abs(flat - (low + high) / 2) > SATURATED * (high - low) / 2
    return {
        "min": flat.min(axis=0).tolist(),
        "mean": flat.mean(axis=0, dtype=np.float64).tolist(),
        "max": flat.max(axis=0).tolist(),
        "std": flat.std(axis=0, dtype=np.float64).tolist(),
        "saturated": saturated.mean(axis=0).tolist(),
    }


def solved_by(data: JoinedDatasets) -> dict[str, np.ndarray]:
    """
    :param data: the dataset
    :return: by source, (longest episode,) share of the episodes that are solved after 1, 2, ... steps; empty without successes
    """
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
    Positions of the hand of ``MultimodalMetaworld-v0``, seen from above.

    :param what: description of the values that were counted
    :param edges: edges of the cells in x and in y, in metres
    :param counts: (x cells, y cells) counts by source, and of all episodes
    :param bodies: mean x and y of each object, in metres
    """

    what: str
    edges: tuple[np.ndarray, np.ndarray]
    counts: dict[str, np.ndarray]
    bodies: dict[str, tuple[float, float]]


def table_coverage(data: JoinedDatasets) -> Coverage | None:
    """
    :param data: the dataset
    :return: the positions of the hand; ``None`` if the data do not hold them
    """
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
    x_edges, y_edges = (
        np.arange(np.floor(a / CELL_SIZE), np.ceil(b / CELL_SIZE) + 1) * CELL_SIZE for a, b in zip(low, high, strict=True)
    )
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
    """
    :param data: the dataset
    :param bins: number of bins
    :return: (counts, edges) of each dimension of a Box action space; values outside the bounds count at the bound
    """
    if not isinstance(data.action_space, spaces.Box):
        return []
    flat = data.actions.reshape(data.n_steps, -1)
    ends = zip(data.action_space.low.reshape(-1), data.action_space.high.reshape(-1), strict=True)
    histograms = []
    for column, (low, high) in zip(flat.T, ends, strict=True):
        low, high = (low, high) if np.isfinite([low, high]).all() else (column.min(), column.max())
        histograms.append(np.histogram(np.clip(column, low, high), bins, (float(low), float(high))))
    return histograms
