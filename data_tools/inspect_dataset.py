"""What is in a dataset, and what looks wrong with it."""

import argparse
import hashlib
import json
import os
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_offline.data.reader import ArrayLike, DatasetSource, OfflineDataset, open_datasets
from sb3_offline.data.spaces import subspaces

SATURATED = 0.99
"""An action counts as saturated beyond this share of its bound."""
SAMPLED_FRAMES = 256
READ_BYTES = 1 << 25


def inspect_dataset(source: str | os.PathLike | OfflineDataset) -> dict[str, Any]:
    """
    Summarise one dataset file. Images are only sampled; all other arrays are read whole.

    :param source: a dataset file
    :return: plain numbers, texts, lists and dicts (JSON); ``warnings`` lists what looks wrong
    """
    dataset = source if isinstance(source, OfflineDataset) else OfflineDataset(source)
    summary: dict[str, Any] = {
        "file": str(dataset.path),
        "bytes": os.path.getsize(dataset.path),
        "storage": dataset.storage,
        "env_id": dataset.env_id,
        "env_kwargs": dataset.env_kwargs,
        "observation_space": str(dataset.observation_space),
        "action_space": str(dataset.action_space),
        "n_episodes": dataset.n_episodes,
        "n_steps": dataset.n_steps,
        "provenance": dataset.provenance,
        "extras": {name: [list(shape), str(np.dtype(dtype))] for name, (shape, dtype) in dataset.header.extras.items()},
    }
    if dataset.n_episodes == 0:
        return {**summary, "warnings": ["there is no episode"]}
    last = dataset.step_starts + dataset.lengths - 1
    summary["lengths"] = _spread(dataset.lengths)
    summary["terminated"] = int(dataset.terminated[last].sum())
    summary["truncated"] = int(dataset.truncated[last].sum())
    summary["groups"] = _groups(dataset)
    actions, warnings = _actions(dataset)
    summary["actions"] = actions
    summary["warnings"] = warnings + _label_warnings(dataset) + _field_warnings(dataset) + _duplicate_warnings(dataset)
    return summary


def _spread(values: np.ndarray) -> dict[str, float]:
    return {name: float(f(values)) for name, f in (("min", np.min), ("mean", np.mean), ("max", np.max), ("std", np.std))}


def _groups(dataset: OfflineDataset) -> dict[str, dict[str, Any]]:
    """Success and returns of all episodes, and of each source's."""
    members = {"all": np.ones(dataset.n_episodes, dtype=bool)}
    if dataset.source is not None:
        members |= {label: dataset.source == index for index, label in enumerate(dataset.sources)}
    groups = {}
    for label, inside in members.items():
        group: dict[str, Any] = {"episodes": int(inside.sum()), "steps": int(dataset.lengths[inside].sum())}
        if dataset.success is not None and inside.any():
            solved = np.logical_or.reduceat(dataset.success, dataset.step_starts)
            group["success"] = float(solved[inside].mean())
            group["success_at_end"] = float(dataset.success[dataset.step_starts + dataset.lengths - 1][inside].mean())
        if dataset.rewards is not None and inside.any():
            returns = np.add.reduceat(dataset.rewards.astype(np.float64), dataset.step_starts)
            group["return"] = _spread(returns[inside])
        groups[label] = group
    return groups


def _actions(dataset: OfflineDataset) -> tuple[dict[str, Any], list[str]]:
    space, actions = dataset.action_space, np.asarray(dataset.actions)
    if not isinstance(space, spaces.Box):
        values, counts = np.unique(actions.reshape(dataset.n_steps, -1), axis=0, return_counts=True)
        return {"counts": {str(value): int(count) for value, count in zip(values.tolist(), counts, strict=True)}}, []
    flat = actions.reshape(dataset.n_steps, -1)
    low, high = space.low.reshape(-1), space.high.reshape(-1)
    middle, half = (low + high) / 2, (high - low) / 2
    summary = {
        "min": flat.min(axis=0).tolist(),
        "mean": flat.mean(axis=0, dtype=np.float64).tolist(),
        "max": flat.max(axis=0).tolist(),
        "std": flat.std(axis=0, dtype=np.float64).tolist(),
        "saturated": (np.abs(flat - middle) > SATURATED * half).mean(axis=0).tolist(),
    }
    warnings = []
    outside = ((flat < low - 1e-4 * half) | (flat > high + 1e-4 * half)).any(axis=1).mean()
    if outside:
        warnings.append(f"actions: {outside:.1%} of the steps are outside of the action space (learners clip them)")
    return summary, warnings


def _label_warnings(dataset: OfflineDataset) -> list[str]:
    warnings = []
    if dataset.success is not None and dataset.success.all():
        warnings.append("success: every step is labelled a success")
    if dataset.success is not None and not dataset.success.any():
        warnings.append("success: no step is labelled a success")
    neither = int((~dataset.terminated & ~dataset.truncated)[dataset.step_starts + dataset.lengths - 1].sum())
    if neither:
        warnings.append(f"terminated, truncated: {neither} episodes end without either")
    return warnings


def _field_warnings(dataset: OfflineDataset) -> list[str]:
    """NaN, constant columns, and values outside of the observation space."""
    warnings = []
    plain = subspaces(dataset.observation_space, "observations")
    for name, array in dataset.arrays.items():
        if name.startswith("episodes/") or name in ("terminated", "truncated", "success") or array.dtype == bool:
            continue
        if len(array.shape) == 4:
            warnings += _image_warnings(name, array)
            continue
        low, high, n_bad = _range(array)
        if n_bad:
            warnings.append(f"{name}: {n_bad} rows hold NaN or infinity")
        constant = np.flatnonzero(low == high)
        if len(array) > 1 and len(constant):
            columns = "" if low.size == 1 else f" in {len(constant)} of {low.size} columns ({_some(constant)})"
            warnings.append(f"{name}: never changes{columns}")
        space = plain.get(name)
        if isinstance(space, spaces.Box):
            outside = np.flatnonzero((low < space.low.reshape(-1)) | (high > space.high.reshape(-1)))
            if len(outside):
                warnings.append(f"{name}: outside of the observation space in {len(outside)} columns ({_some(outside)})")
    return warnings


def _range(array: ArrayLike) -> tuple[np.ndarray, np.ndarray, int]:
    """:return: smallest and largest finite value of each column, and the number of rows that are not finite"""
    columns = int(np.prod(array.shape[1:]))
    low, high, n_bad = np.full(columns, np.inf), np.full(columns, -np.inf), 0
    rows = max(READ_BYTES // max(columns * array.dtype.itemsize, 1), 1)
    for first in range(0, len(array), rows):
        piece = array[first : first + rows].reshape(-1, columns)
        finite = np.isfinite(piece).all(axis=1)
        n_bad += int((~finite).sum())
        if finite.any():
            low, high = np.minimum(low, piece[finite].min(axis=0)), np.maximum(high, piece[finite].max(axis=0))
    return low, high, n_bad


def _image_warnings(name: str, array: ArrayLike) -> list[str]:
    rows = np.unique(np.linspace(0, len(array) - 1, SAMPLED_FRAMES).astype(int))
    frames = array[rows].reshape(len(rows), -1)
    if not np.isfinite(frames).all():
        return [f"{name}: images hold NaN or infinity"]
    warnings = []
    blank = (frames == frames[:, :1]).all(axis=1).mean()
    if blank:
        warnings.append(f"{name}: {blank:.1%} of {len(rows)} sampled images are of one colour")
    elif len(rows) > 1 and (frames == frames[0]).all():
        warnings.append(f"{name}: all of {len(rows)} sampled images are the same")
    if frames.dtype == np.uint8 and frames.max() <= 1:
        warnings.append(f"{name}: the sampled images hold only 0 and 1, as if scaled to [0, 1] before the cast to uint8")
    return warnings


def _duplicate_warnings(dataset: OfflineDataset) -> list[str]:
    """Episodes of the same actions and the same first and last observations."""
    arrays = [dataset.arrays[name] for name in subspaces(dataset.observation_space, "observations")]
    first = dataset.observation_starts
    ends = [np.asarray(array[np.concatenate([first, first + dataset.lengths])]) for array in arrays]
    seen: dict[bytes, int] = {}
    duplicates = []
    for episode, (start, length) in enumerate(zip(dataset.step_starts, dataset.lengths, strict=True)):
        digest = hashlib.blake2b(np.ascontiguousarray(dataset.actions[start : start + length]).tobytes())
        for end in ends:
            digest.update(end[episode].tobytes() + end[dataset.n_episodes + episode].tobytes())
        if seen.setdefault(digest.digest(), episode) != episode:
            duplicates.append(episode)
    return [f"{len(duplicates)} episodes repeat an earlier one ({_some(np.array(duplicates))})"] if duplicates else []


def _some(indices: np.ndarray) -> str:
    return ", ".join(map(str, indices[:8].tolist())) + (", ..." if len(indices) > 8 else "")


def format_summary(summary: dict[str, Any]) -> str:
    """
    :param summary: from ``inspect_dataset``
    :return: a text for the terminal
    """
    lines = [f"{summary['file']}  ({summary['bytes'] / 1e6:,.1f} MB, {summary['storage']})"]
    about = {"environment": f"{summary['env_id'] or '-'} {summary['env_kwargs'] or ''}".rstrip()}
    about |= {"observations": summary["observation_space"], "actions": summary["action_space"]}
    about |= {f"extras/{name}": f"{shape} {dtype}" for name, (shape, dtype) in summary["extras"].items()}
    about |= summary["provenance"]
    lines += [f"  {key:<{max(map(len, about))}}  {value}" for key, value in about.items()]
    counts = f"  {summary['n_episodes']:,} episodes, {summary['n_steps']:,} steps"
    if "lengths" in summary:
        lengths = summary["lengths"]
        counts += f" ({lengths['min']:.0f} to {lengths['max']:.0f} each); "
        counts += f"{summary['terminated']:,} terminated, {summary['truncated']:,} truncated"
        lines += [counts, "", *_group_table(summary["groups"])]
        lines += ["", *_action_table(summary["actions"])]
    else:
        lines += [counts]
    lines += ["", *(f"  WARNING {warning}" for warning in summary["warnings"])]
    return "\n".join(lines if summary["warnings"] else [*lines, "  no warnings"])


def _group_table(groups: dict[str, dict[str, Any]]) -> list[str]:
    width = max(6, *map(len, groups))
    lines = [
        f"  {'source':<{width}} {'episodes':>9} {'steps':>10} {'success':>8} {'at end':>7} {'mean return (min to max)':>34}"
    ]
    for label, group in groups.items():
        success = f"{group['success']:>8.1%} {group['success_at_end']:>7.1%}" if "success" in group else f"{'-':>8} {'-':>7}"
        spread = group.get("return")
        returns = f"{spread['mean']:.5g} ({spread['min']:.5g} to {spread['max']:.5g})" if spread else "-"
        lines.append(f"  {label:<{width}} {group['episodes']:>9,} {group['steps']:>10,} {success} {returns:>34}")
    return lines


def _action_table(actions: dict[str, Any]) -> list[str]:
    if "counts" in actions:
        return [f"  action {value:<12} {count:>10,} steps" for value, count in actions["counts"].items()]
    lines = [f"  {'action':<8} {'min':>9} {'mean':>9} {'max':>9} {'std':>9} {'saturated':>10}"]
    columns = zip(*(actions[key] for key in ("min", "mean", "max", "std", "saturated")), strict=True)
    for index, (low, mean, high, std, saturated) in enumerate(columns):
        lines.append(f"  {index:<8} {low:>9.3g} {mean:>9.3g} {high:>9.3g} {std:>9.3g} {saturated:>10.1%}")
    return lines


def inspect_datasets(source: DatasetSource) -> list[dict[str, Any]]:
    """:return: a summary for each of several files of one environment"""
    return [inspect_dataset(dataset) for dataset in open_datasets(source)]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: gets the options of ``run``"""
    parser.add_argument("dataset", nargs="+", help="dataset files or patterns")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a text")


def run(args: argparse.Namespace) -> None:
    """:param args: what ``add_arguments`` asks for"""
    summaries = inspect_datasets(args.dataset)
    print(json.dumps(summaries, indent=2) if args.json else "\n\n".join(map(format_summary, summaries)))
