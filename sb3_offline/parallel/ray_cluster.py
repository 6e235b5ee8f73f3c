"""Independent jobs as tasks of a Ray cluster. Needs the optional package ``ray``."""

import functools
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import ray

from sb3_offline.parallel.processes import prepare_worker

Job = TypeVar("Job")
Result = TypeVar("Result")

RETRY_SECONDS = 2.0
"""Pause before a retry. A worker on a lost node holds its file locks until it is gone."""
MAX_RETRIES = 100


def run_tasks(
    function: Callable[[Job], Result], jobs: Iterable[Job], address: str, *, retry_on: type[Exception]
) -> Iterator[tuple[Job, Callable[[], Result]]]:
    """
    Run each job as a task of one CPU. When a worker or a node dies, the task starts again on another one.

    :param function: the work. It must be able to continue what a killed worker left.
    :param jobs: the arguments. They start in this order.
    :param address: address of the cluster: "auto" for the one that this machine belongs to, "local" to start one
    :param retry_on: error after which a task starts again, such as a lock that a lost worker still holds
    :return: each job when it has ended, and a function that returns its result or raises a ``RayError`` (after all retries)
    """
    started_here = not ray.is_initialized()
    if started_here:
        ray.init(address=address, log_to_driver=False)
    try:
        remote: Any = ray.remote(num_cpus=1, max_retries=MAX_RETRIES, retry_exceptions=[retry_on])(_work_on)
        tasks: dict[Any, Job] = {remote.remote(function, job, retry_on): job for job in jobs}
        while tasks:
            for done in ray.wait(list(tasks))[0]:
                yield tasks.pop(done), functools.partial(ray.get, done)
    finally:
        if started_here:
            ray.shutdown()


def _work_on(function: Callable[[Job], Result], job: Job, retry_on: type[Exception]) -> Result:
    prepare_worker()
    try:
        return function(job)
    except retry_on:
        time.sleep(RETRY_SECONDS)
        raise
