"""
The paper's kind of dataset: rollouts of SAC agents at several points of their training, about a third of them successful.

Episode i of a task is the same in every collection of one seed: its checkpoint, the places of the objects and the noise of the
actions come from (seed, task, i) alone. Workers, shards and restarts therefore change nothing. Episodes are never chosen or
changed by how they went: the share of successful ones comes from how often each checkpoint is taken.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from tqdm.auto import tqdm

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import save_examples
from sb3_offline.data.reader import DatasetSource, OfflineDataset, open_datasets
from sb3_offline.data.selection import of_source
from sb3_offline.data_tools.extract_examples import extract_examples
from sb3_offline.data_tools.rollout import (
    TaskEpisode,
    add_episode,
    check_tasks,
    episode_writer,
    roll_out,
    shared_env,
    versions,
)
from sb3_offline.data_tools.sac_policies import SacActor, load_actor, load_policies, mix_weights
from sb3_offline.data_tools.workers import map_in_order
from sb3_offline.envs.multimodal_metaworld import TASKS

POLICIES = Path(__file__).parent / "policies"
SAMPLES = Path(__file__).parent / "samples"
"""``sac_states.h5`` and ``sac_pixels.h5``: four episodes a task of seed 1, compressed."""
PAPER_SHARES = {"dial-turn": 0.33, "door-open": 0.31, "drawer-open": 0.28, "lever-pull": 0.35, "plate-slide": 0.33}
"""Of successful episodes, by task, as the CEBORL paper reports of its data."""
BEHAVIOUR = "stock SB3 SAC agents, trained for one task each from states, at several points of their training; sampled actions"
HELD_OUT_STREAM = 1
_GOLDEN = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class Collection:
    """
    What decides every episode.

    :param episodes_per_task: how many attempts at each task
    :param tasks: which of `TASKS`; they take turns
    :param obs_type: "state" or "pixels": the same episodes either way
    :param seed: of the whole collection
    :param held_out: whether to take episodes that no other collection of the seed holds, for success examples
    :param policies: folder of the checkpoints
    """

    episodes_per_task: int = 1500
    tasks: tuple[str, ...] = tuple(TASKS)
    obs_type: str = "state"
    seed: int = 0
    held_out: bool = False
    policies: str = str(POLICIES)


class _Job(NamedTuple):
    task: str
    number: int


class _Agents(NamedTuple):
    """Checkpoints of one task and the cumulative weights with which they are taken."""

    actors: list[SacActor]
    cumulative: np.ndarray


@functools.lru_cache(maxsize=5)
def _agents(policies: str, task: str) -> _Agents:
    checkpoints = load_policies(policies)[task]
    weights = mix_weights([checkpoint.success_rate for checkpoint in checkpoints], PAPER_SHARES[task])
    return _Agents([load_actor(checkpoint.file) for checkpoint in checkpoints], np.cumsum(weights))


def _episode(collection: Collection, job: _Job) -> TaskEpisode:
    agents = _agents(collection.policies, job.task)
    stream = (collection.seed, HELD_OUT_STREAM * collection.held_out, TASKS.index(job.task))
    # Multiples of the golden ratio: after any number of episodes, each checkpoint was taken as often as its weight says.
    place = (np.random.default_rng(stream).random() + job.number * _GOLDEN) % 1.0
    actor = agents.actors[min(int(np.searchsorted(agents.cumulative, place, side="right")), len(agents.actors) - 1)]
    rng = np.random.default_rng((*stream, job.number))
    env = shared_env(collection.obs_type)
    scene_env: Any = env.unwrapped
    return roll_out(env, job.task, int(rng.integers(2**31)), lambda decision, solved: actor.act(scene_env.get_state(), rng))


def shard_path(path: Path, shard: int, n_shards: int) -> Path:
    """
    :param path: of the dataset in one file
    :param shard: 0 to n_shards - 1
    :param n_shards: how many files there are
    :return: of one shard; names sort in the order of the episodes
    """
    return path if n_shards == 1 else path.with_name(f"{path.stem}-{shard:04d}-of-{n_shards:04d}{path.suffix}")


def collect_shard(
    path: Path, collection: Collection, shard: int = 0, n_shards: int = 1, *, n_workers: int = 1, progress: bool = True
) -> Path:
    """
    Collect one part of a dataset, or go on where a killed process left off. The shards one after the other hold the episodes
    in the same order as one file of them all.

    :param path: of the dataset in one file; see `shard_path`
    :param collection: the whole one
    :param shard: which part
    :param n_shards: of so many
    :param n_workers: processes; the file is the same for any number
    :param progress: whether to show a progress bar
    :return: the path of the shard; raises ``DatasetError`` where a file of something else is in the way, or is being written
    """
    check_tasks(collection.tasks)
    if n_shards > collection.episodes_per_task:
        problem = f"are {n_shards}, but a task has {collection.episodes_per_task} episodes"
        raise DatasetError(path, "shards", problem, "Make fewer shards, or collect more episodes")
    path = shard_path(path, shard, n_shards)
    bounds = [collection.episodes_per_task * i // n_shards for i in (shard, shard + 1)]
    jobs = [_Job(task, number) for number in range(*bounds) for task in collection.tasks]
    provenance = _provenance(collection, shard, n_shards)
    mode: Literal["x", "a"] = "x"
    if path.exists():
        mode, present = "a", OfflineDataset(path)
        if present.provenance != provenance or present.sources != [*collection.tasks]:  # in this order they take turns
            problem = "holds other data than these options ask for"
            raise DatasetError(path, "provenance", problem, "Name another file, or delete this one")
        jobs = jobs[present.n_episodes :]
    if not jobs:
        return path
    with (
        episode_writer(path, collection.obs_type, collection.tasks, len(jobs), provenance, mode) as writer,
        tqdm(total=writer.n_episodes + len(jobs), initial=writer.n_episodes, unit="episode", disable=not progress) as bar,
    ):
        bar.set_description(path.name)
        for episode in map_in_order(functools.partial(_episode, collection), jobs, n_workers):
            add_episode(writer, episode)
            bar.update()
    return path


def _provenance(collection: Collection, shard: int, n_shards: int) -> dict[str, Any]:
    known = load_policies(collection.policies)
    mix = {}
    for task in collection.tasks:
        if task not in known:
            raise DatasetError(
                collection.policies, "tasks", f"has no {task}", f"Choose of {', '.join(known) or 'none'} (--tasks)"
            )
        weights = mix_weights([checkpoint.success_rate for checkpoint in known[task]], PAPER_SHARES[task])
        mix[task] = [
            {
                "run": checkpoint.run,
                "step": checkpoint.step,
                "sha256": checkpoint.sha256,
                "success_rate": round(checkpoint.success_rate, 4),
                "weight": weight,
            }
            for checkpoint, weight in zip(known[task], weights.round(6).tolist(), strict=True)
        ]
    options = {name: value for name, value in asdict(collection).items() if name not in ("obs_type", "policies", "tasks")}
    return {
        "program": "sb3_offline.data_tools.collect_sac",
        "policy": BEHAVIOUR,
        **options,
        "shard": [shard, n_shards],
        "mix": mix,
        "versions": versions(),
    }


def content_hash(source: DatasetSource) -> str:
    """
    What must come out again for the same seed and versions. Files of states and of frames of the same episodes have the same
    hash, and so have shards and the whole.

    :param source: dataset files of this program
    :return: SHA-256 over actions and scene states (joint, mocap and object positions), in order, hexadecimal
    """
    digest = hashlib.sha256()
    for dataset in open_datasets(source):
        for start, length in zip(dataset.step_starts, dataset.lengths, strict=True):
            for array in (dataset.actions, dataset.extras["scene_state"]):
                digest.update(np.ascontiguousarray(array[start : start + length]).tobytes())
    return digest.hexdigest()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: gets the options of ``run``"""
    parser.add_argument("output", type=Path, help="HDF5 file to write; an incomplete one is continued")
    parser.add_argument("--episodes-per-task", type=int, default=1500)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS), help="default: all five")
    parser.add_argument("--obs-type", choices=("state", "pixels"), default="state", help="the same episodes either way")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--policies", type=Path, default=POLICIES, help="folder of export-sac (default: the shipped one)")
    parser.add_argument("--workers", type=int, default=2, help="processes; the file is the same for any number")
    parser.add_argument("--shard", type=_shard, metavar="i/n", help="write part i (0 to n-1) of n only")
    parser.add_argument("--ray", metavar="ADDRESS", help='write --shards parts as tasks of a Ray cluster ("auto", "local")')
    parser.add_argument("--shards", type=int, default=8, help="with --ray (default: 8)")
    parser.add_argument("--examples", type=Path, help="folder for success examples of each task")
    parser.add_argument("--example-count", type=int, default=200, help="of each task (default: 200)")
    parser.add_argument("--example-episodes", type=int, default=100, help="held-out attempts at each task to draw them from")
    parser.add_argument("--examples-from", choices=("held-out", "data"), default="held-out")
    parser.add_argument("--card", type=Path, help="JSON file for what the dataset is made of")


def _shard(text: str) -> tuple[int, int]:
    shard, _, n_shards = text.partition("/")
    if not (shard.isdecimal() and n_shards.isdecimal() and int(shard) < int(n_shards)):
        raise argparse.ArgumentTypeError(f"{text!r} is not i/n with 0 <= i < n")
    return int(shard), int(n_shards)


def run(args: argparse.Namespace) -> None:
    """:param args: what ``add_arguments`` asks for"""
    started = time.time()
    collection = Collection(
        args.episodes_per_task, tuple(args.tasks), args.obs_type, args.seed, policies=str(args.policies.resolve())
    )
    if args.ray:
        from sb3_offline.data_tools.collect_ray import collect_on_ray

        paths = collect_on_ray(args.output, collection, args.shards, address=args.ray)
    else:
        paths = [collect_shard(args.output, collection, *(args.shard or (0, 1)), n_workers=args.workers)]
    seconds = time.time() - started
    for task, share in success_shares(paths).items():
        print(f"{task:<12} {share:6.1%} of the episodes solved (in the paper {PAPER_SHARES[task]:.0%})")
    print(f"sha256 of actions and scene states: {content_hash(paths)}")
    if args.examples:
        write_examples(args.examples, paths, collection, args)
    if args.card:
        from sb3_offline.data_tools.dataset_card import write_card

        write_card(args.card, paths, seconds)


def success_shares(source: DatasetSource) -> dict[str, float]:
    """
    :param source: dataset files of this program
    :return: by task, the share of episodes that were solved at some decision
    """
    solved: dict[str, list[np.ndarray]] = {}
    for dataset in open_datasets(source):
        episodes = np.logical_or.reduceat(dataset.success, dataset.step_starts)  # type: ignore[arg-type]
        for task in dataset.sources:
            solved.setdefault(task, []).append(episodes[of_source(dataset, task)])
    return {task: float(np.concatenate(parts).mean()) for task, parts in solved.items()}


def write_examples(folder: Path, paths: Sequence[Path], collection: Collection, args: argparse.Namespace) -> None:
    """
    :param folder: gets a file of success examples for each task, and the held-out episodes that they are from
    :param paths: of the data
    :param collection: of the data
    :param args: with `examples_from`, `example_count`, `example_episodes` and `workers`
    """
    held_out = args.examples_from == "held-out"
    folder.mkdir(parents=True, exist_ok=True)
    if held_out:
        options = {**asdict(collection), "held_out": True, "episodes_per_task": args.example_episodes}
        paths = [collect_shard(folder / "held_out.h5", Collection(**options), n_workers=args.workers)]
    datasets = open_datasets(list(paths))
    for task in collection.tasks:
        examples, provenance = extract_examples(
            datasets, args.example_count, source=task, seed=collection.seed, held_out=held_out
        )
        save_examples(folder / f"{task}.h5", examples, datasets[0].observation_space, provenance)
    print(f"{args.example_count} success examples of each task -> {folder}")
