"""Train the runs of a grid on a Ray cluster whose nodes share a file system, in one task each."""

import functools
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import ray

from sb3_offline.benchmark.grid import GridRun
from sb3_offline.benchmark.worker import complete_run, record_failure
from sb3_offline.data.errors import DatasetError
from sb3_offline.parallel.ray_cluster import run_tasks


def train_on_ray(runs: Iterable[GridRun], address: str) -> Iterator[GridRun]:
    """
    Train runs. When a worker or a node dies, another one continues its run from the last save, and a lock keeps a second
    worker away.

    :param runs: unfinished runs; they start in this order
    :param address: address of the cluster: "auto" for the one that this machine belongs to, "local" to start one
    :return: each run when it is finished or has failed
    """
    for run, result in run_tasks(functools.partial(_work, Path.cwd()), runs, address, retry_on=DatasetError):
        try:
            result()
        except ray.exceptions.RayError as error:  # after all retries; the other runs continue
            record_failure(run, f"{type(error).__name__}: {error}")
        yield run


def _work(folder: Path, run: GridRun) -> None:
    os.chdir(folder)  # paths in a grid are relative to the user's folder
    complete_run(run)
