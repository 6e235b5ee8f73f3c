"""`collect-sac` on a Ray cluster whose nodes share a file system: each task writes one shard."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import ray

from sb3_offline.data.errors import DatasetError
from sb3_offline.data_tools.collect_sac import Collection, collect_shard

RETRY_SECONDS = 2.0
"""A worker of a lost node holds the lock of its shard until it is gone."""
MAX_RETRIES = 100


@ray.remote(num_cpus=1, max_retries=MAX_RETRIES, retry_exceptions=[DatasetError])  # type: ignore[call-overload]
def _collect(path: str, collection: Collection, shard: int, n_shards: int) -> str:
    try:
        return str(collect_shard(Path(path), collection, shard, n_shards, progress=False))
    except DatasetError:
        time.sleep(RETRY_SECONDS)
        raise


def collect_on_ray(path: Path, collection: Collection, n_shards: int, *, address: str) -> list[Path]:
    """
    Collect all shards as Ray tasks. When a worker or a node dies, another one goes on with its shard: episodes that were
    written stay, and the file's lock keeps a second writer away.

    :param path: of the dataset in one file; the shards stand beside it, on a file system that all nodes share
    :param collection: the whole one
    :param n_shards: files, and tasks
    :param address: of the cluster: "auto" for the one this machine belongs to, "local" to start one
    :return: paths of the shards
    """
    started_here = not ray.is_initialized()
    if started_here:
        ray.init(address=address, log_to_driver=False)
    try:
        waiting: list[Any] = [_collect.remote(str(path.resolve()), collection, shard, n_shards) for shard in range(n_shards)]
        paths = []
        while waiting:
            done, waiting = ray.wait(waiting)
            paths += ray.get(done)
            print(f"{len(paths)} of {n_shards} shards are complete", flush=True)
        return sorted(map(Path, paths))
    finally:
        if started_here:
            ray.shutdown()
