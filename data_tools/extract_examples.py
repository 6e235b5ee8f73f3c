"""Success examples out of a dataset with success labels."""

import argparse
import os
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import Observations, save_examples
from sb3_offline.data.reader import DatasetSource, OfflineDataset, open_datasets
from sb3_offline.data.selection import check_source, of_source


def extract_examples(
    dataset: DatasetSource, n: int = 200, *, source: str | None = None, seed: int = 0, held_out: bool = False
) -> tuple[Observations, dict[str, Any]]:
    """
    Draw observations in which the task is solved, uniformly and without repetition: those that steps labelled
    ``success`` led to.

    :param dataset: path, glob pattern, ``OfflineDataset``, or a sequence of these
    :param n: number of examples
    :param source: take episodes of this source only, e.g. "door-open" in a file of several tasks
    :param seed: seed of the draw
    :param held_out: recorded: whether these episodes are kept out of the data that will be learned from
    :return: ``(n, *shape)`` observations, or a dict of such for a Dict space, in the dataset's layout; and their provenance
    """
    datasets = open_datasets(dataset)
    if source is not None:
        check_source(datasets, source)
    steps_of = [_success_steps(part, source) for part in datasets]
    counts = [len(steps) for steps in steps_of]
    if sum(counts) < n:
        problem = f"holds {sum(counts)} steps with success{f' of source {source!r}' if source else ''}, asked for {n}"
        raise DatasetError(datasets[0].path, "success", problem, "Ask for fewer examples, or collect more episodes")
    chosen = np.sort(np.random.default_rng(seed).choice(sum(counts), n, replace=False))
    origins, parts = [], []
    for part, steps, first in zip(datasets, steps_of, np.cumsum(counts) - counts, strict=True):
        mine = steps[chosen[(chosen >= first) & (chosen < first + len(steps))] - first]
        episodes = np.searchsorted(part.step_starts, mine, side="right") - 1
        rows = mine + episodes + 1  # the observation after the step; each episode before has one row more than steps
        parts.append(_rows(part, rows))
        origins.append({"file": part.path.name, "episodes": np.unique(episodes).tolist(), "provenance": part.provenance})
    provenance = {
        "program": "sb3_offline.data_tools.extract_examples",
        "n": n,
        "source": source,
        "seed": seed,
        "held_out": held_out,
        "datasets": origins,
    }
    if isinstance(datasets[0].observation_space, spaces.Dict):
        return {key: np.concatenate([p[key] for p in parts]) for key in datasets[0].observation_space}, provenance
    return np.concatenate([p["observations"] for p in parts]), provenance


def _success_steps(dataset: OfflineDataset, source: str | None) -> np.ndarray:
    if dataset.success is None:
        remedy = "Give success examples as an .npz or a folder of pictures instead"
        raise DatasetError(dataset.path, "success", "is missing: the file has no success labels", remedy)
    wanted = np.asarray(dataset.success)
    if source is not None:
        wanted = wanted & np.repeat(of_source(dataset, source), dataset.lengths)
    return np.flatnonzero(wanted)


def _rows(dataset: OfflineDataset, rows: np.ndarray) -> dict[str, np.ndarray]:
    observations = dataset.observations
    arrays = observations if isinstance(observations, dict) else {"observations": observations}
    return {key: array[rows] for key, array in arrays.items()}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: gets the options of ``run``"""
    parser.add_argument("dataset", nargs="+", help="dataset files or patterns")
    parser.add_argument("-o", "--output", required=True, help="HDF5 file to write")
    parser.add_argument("-n", "--count", type=int, default=200, help="number of examples (default: 200)")
    parser.add_argument("--source", help="only episodes of this source, e.g. door-open")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw (default: 0)")
    parser.add_argument("--held-out", action="store_true", help="record that these episodes are not learned from")
    parser.add_argument("--overwrite", action="store_true", help="replace the output file")


def run(args: argparse.Namespace) -> None:
    """:param args: what ``add_arguments`` asks for"""
    if os.path.exists(args.output) and not args.overwrite:
        raise DatasetError(args.output, "file", "exists already", "Give --overwrite to replace it")
    datasets = open_datasets(args.dataset)
    examples, provenance = extract_examples(datasets, args.count, source=args.source, seed=args.seed, held_out=args.held_out)
    save_examples(args.output, examples, datasets[0].observation_space, provenance)
    n_episodes = sum(len(origin["episodes"]) for origin in provenance["datasets"])
    print(f"{args.count} examples from {n_episodes} episodes -> {args.output}")
