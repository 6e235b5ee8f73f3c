"""The runs of a grid on a Ray cluster whose nodes share a file system: a task each."""

import os
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import ray

from sb3_offline.benchmark.grid import Run
from sb3_offline.benchmark.worker import record_failure, train_run
from sb3_offline.data.errors import DatasetError
from sb3_offline.data_tools.workers import prepare_worker

RETRY_SECONDS = 2.0
"""A worker of a lost node holds the lock of its run until it is gone."""
MAX_RETRIES = 100


@ray.remote(num_cpus=1, max_retries=MAX_RETRIES, retry_exceptions=[DatasetError])  # type: ignore[call-overload]
def _train(run: Run, folder: Path) -> None:
    os.chdir(folder)  # paths in a grid are as the user sees them
    prepare_worker()
    try:
        train_run(run)
    except DatasetError:
        time.sleep(RETRY_SECONDS)
        raise


def train_on_ray(runs: Iterable[Run], address: str) -> Iterator[Run]:
    """
    When a worker or a node dies, another one goes on with its run from the last save, and a lock keeps a second one away.

    :param runs: that are not finished, in the order in which to start them
    :param address: of the cluster: "auto" for the one this machine belongs to, "local" to start one
    :return: each run when it is finished or has failed
    """
    started_here = not ray.is_initialized()
    if started_here:
        ray.init(address=address, log_to_driver=False)
    try:
        tasks: dict[Any, Run] = {_train.remote(run, Path.cwd()): run for run in runs}
        while tasks:
            for done in ray.wait(list(tasks))[0]:
                run = tasks.pop(done)
                try:
                    ray.get(done)
                except ray.exceptions.RayError as error:  # after all retries; the other runs go on
                    record_failure(run, f"{type(error).__name__}: {error}")
                yield run
    finally:
        if started_here:
            ray.shutdown()
