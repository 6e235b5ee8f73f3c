"""
Data of the paper's kind: rollouts of SAC agents at several points of their training, about a third of them successful.

Episode i of a task is the same in every collection with the same seed: its checkpoint, the object positions and the action
noise depend on (seed, task, i) alone, so workers, shards and restarts change nothing. No episode is selected or modified by
its outcome: the share of successful episodes follows from how often each checkpoint is used.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from tqdm.auto import tqdm

from sb3_offline.common.provenance import SIMULATION_PACKAGES, installed_versions
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import save_examples
from sb3_offline.data.reader import DatasetLike, OfflineDataset, open_datasets
from sb3_offline.data.selection import of_source
from sb3_offline.data_tools import POLICIES
from sb3_offline.data_tools.collecting.rollout import (
    TaskEpisode,
    add_episode,
    check_tasks,
    episode_writer,
    roll_out,
    shared_env,
)
from sb3_offline.data_tools.converting.extract_examples import extract_examples
from sb3_offline.data_tools.sac.policies import SacActor, load_actor, load_policies, mix_weights
from sb3_offline.envs.multimodal_metaworld import TASKS
from sb3_offline.parallel.processes import map_in_order

PAPER_SHARES = {"dial-turn": 0.33, "door-open": 0.31, "drawer-open": 0.28, "lever-pull": 0.35, "plate-slide": 0.33}
"""Share of successful episodes by task, as the CEBORL paper reports it for its data."""
SAC_BEHAVIOUR = (
    "stock SB3 SAC agents, trained for one task each from states, at several points of their training; sampled actions"
)
# Recorded in the files. It stays when this module moves, because a file is continued only if its whole record is the same.
PROGRAM = "sb3_offline.data_tools.collecting.sac"
HELD_OUT_STREAM = 1
_GOLDEN = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class Collection:
    """
    Everything that decides the episodes of a dataset.

    :param episodes_per_task: number of attempts at each task
    :param tasks: some of `TASKS`, which take turns
    :param obs_type: "state", "pixels" or "both": the episodes are the same either way
    :param seed: seed of the whole collection
    :param held_out: use episodes that no ordinary collection with this seed contains, for success examples
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
    episode: int


class _Agents(NamedTuple):
    """The checkpoints of one task, and the cumulative weights with which they are used."""

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
    # Multiples of the golden ratio: after any number of episodes, each checkpoint has been used as often as its weight says.
    place = (np.random.default_rng(stream).random() + job.episode * _GOLDEN) % 1.0
    actor = agents.actors[min(int(np.searchsorted(agents.cumulative, place, side="right")), len(agents.actors) - 1)]
    rng = np.random.default_rng((*stream, job.episode))
    env = shared_env(collection.obs_type)
    scene_env: Any = env.unwrapped
    return roll_out(env, job.task, int(rng.integers(2**31)), lambda decision, solved: actor.act(scene_env.get_state(), rng))


def shard_path(path: Path, shard: int, n_shards: int) -> Path:
    """
    :param path: path of the dataset if it were one file
    :param shard: 0 to n_shards - 1
    :param n_shards: number of files
    :return: path of one shard; the names sort in the order of the episodes
    """
    return path if n_shards == 1 else path.with_name(f"{path.stem}-{shard:04d}-of-{n_shards:04d}{path.suffix}")


def collect_shard(
    path: Path, collection: Collection, shard: int = 0, n_shards: int = 1, *, n_workers: int = 1, progress: bool = True
) -> Path:
    """
    Collect one part of a dataset, or continue where a killed process stopped. The shards in order hold the same episodes as
    one file of the whole dataset.

    :param path: path of the dataset if it were one file; see `shard_path`
    :param collection: the whole collection
    :param shard: index of the part
    :param n_shards: number of parts
    :param n_workers: number of processes, which does not change the file
    :param progress: show a progress bar
    :return: path of the shard; raises ``DatasetError`` if the file holds other data or is being written by another process
    """
    check_tasks(collection.tasks)
    if n_shards > collection.episodes_per_task:
        problem = f"are {n_shards}, but a task has {collection.episodes_per_task} episodes"
        raise DatasetError(path, "shards", problem, "Make fewer shards, or collect more episodes")
    path = shard_path(path, shard, n_shards)
    bounds = [collection.episodes_per_task * i // n_shards for i in (shard, shard + 1)]
    jobs = [_Job(task, episode) for episode in range(*bounds) for task in collection.tasks]
    provenance = _provenance(collection, shard, n_shards)
    mode: Literal["x", "a"] = "x"
    if path.exists():
        mode, present = "a", OfflineDataset(path)
        if present.provenance != provenance or present.sources != [*collection.tasks]:  # they take turns in this order
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
            remedy = f"Choose from {', '.join(known) or 'none'} (--tasks)"
            raise DatasetError(collection.policies, "tasks", f"has no {task}", remedy)
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
        "program": PROGRAM,
        "policy": SAC_BEHAVIOUR,
        **options,
        "shard": [shard, n_shards],
        "mix": mix,
        "versions": installed_versions(SIMULATION_PACKAGES),
    }


def content_hash(source: DatasetLike) -> str:
    """
    Hash what the same seed and versions must reproduce. Files of states and files of images of the same episodes have the same
    hash, and so do the shards and the whole dataset.

    :param source: dataset files of this program
    :return: SHA-256 over actions and scene states (joint, mocap and object positions), in order, hexadecimal
    """
    digest = hashlib.sha256()
    for dataset in open_datasets(source):
        for start, length in zip(dataset.step_starts, dataset.lengths, strict=True):
            for array in (dataset.actions, dataset.extras["scene_state"]):
                digest.update(np.ascontiguousarray(array[start : start + length]).tobytes())
    return digest.hexdigest()


def success_shares(source: DatasetLike) -> dict[str, float]:
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


def write_examples(
    folder: Path,
    paths: Sequence[Path],
    collection: Collection,
    n_examples: int,
    *,
    held_out_episodes: int | None,
    n_workers: int = 1,
) -> None:
    """
    Write a file of success examples for each task of a collection.

    :param folder: folder for the files, and for the held-out episodes that the examples come from
    :param paths: files of the dataset
    :param collection: the collection that these files hold
    :param n_examples: number of examples of each task
    :param held_out_episodes: number of further attempts at each task, from which the examples are drawn; ``None`` draws them
        from the dataset itself
    :param n_workers: number of processes
    """
    held_out = held_out_episodes is not None
    folder.mkdir(parents=True, exist_ok=True)
    if held_out_episodes is not None:
        attempts = replace(collection, held_out=True, episodes_per_task=held_out_episodes)
        paths = [collect_shard(folder / "held_out.h5", attempts, n_workers=n_workers)]
    datasets = open_datasets(list(paths))
    for task in collection.tasks:
        examples, provenance = extract_examples(datasets, n_examples, source=task, seed=collection.seed, held_out=held_out)
        save_examples(folder / f"{task}.h5", examples, datasets[0].observation_space, provenance)
