"""`collect-sac` on a Ray cluster whose nodes share a file system: each task writes one shard."""

import functools
from pathlib import Path

from sb3_offline.data.errors import DatasetError
from sb3_offline.data_tools.collecting.sac import Collection, collect_shard
from sb3_offline.parallel.ray_cluster import run_tasks


def collect_on_ray(path: Path, collection: Collection, n_shards: int, *, address: str) -> list[Path]:
    """
    Collect all shards as Ray tasks. When a worker or a node dies, another one continues its shard: finished episodes stay, and
    the lock of the file keeps a second writer away.

    :param path: path of the dataset if it were one file. The shards stand beside it, on a file system that all nodes share.
    :param collection: the whole collection
    :param n_shards: number of files, and of tasks
    :param address: address of the cluster: "auto" for the one that this machine belongs to, "local" to start one
    :return: paths of the shards
    """
    collect = functools.partial(_collect, path.resolve(), collection, n_shards)
    paths: list[Path] = []
    for _, result in run_tasks(collect, range(n_shards), address, retry_on=DatasetError):
        paths.append(result())
        print(f"{len(paths)} of {n_shards} shards are complete", flush=True)
    return sorted(paths)


def _collect(path: Path, collection: Collection, n_shards: int, shard: int) -> Path:
    return collect_shard(path, collection, shard, n_shards, progress=False)
