"""Independent jobs in worker processes on this machine."""

import contextlib
import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, wait
from multiprocessing.connection import wait as wait_for_exit
from multiprocessing.context import SpawnProcess
from typing import Any, TypeVar

Job = TypeVar("Job")
Result = TypeVar("Result")

JOBS_AHEAD = 4
"""Number of jobs handed out per worker: enough to keep it busy, and few enough for the results to wait in memory."""
POLL_SECONDS = 0.5


def map_in_order(function: Callable[[Job], Result], jobs: Iterable[Job], n_workers: int) -> Iterator[Result]:
    """
    Apply a function to each job and yield the results in the order of the jobs.

    :param function: the work. It must be picklable. Anything that it caches (``functools.lru_cache``) stays in its worker.
    :param jobs: the arguments. They are taken one at a time, shortly before a worker becomes free.
    :param n_workers: number of processes. With 1, the jobs run in the calling process.
    :return: the results. An error in a job is raised here, after the other jobs that have started are done.
    """
    if n_workers <= 1:
        yield from map(function, jobs)
        return
    waiting: deque[Future[Result]] = deque()
    pool = _pool(n_workers)
    try:
        for job in jobs:
            waiting.append(pool.submit(function, job))
            if len(waiting) == JOBS_AHEAD * n_workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def run_all(jobs: Iterable[Callable[[], Any]], n_workers: int, at_poll: Callable[[], None]) -> None:
    """
    Run jobs that belong together. As soon as one of them fails, the others are terminated and its error is raised.

    :param jobs: the work. Jobs must be picklable, and they start in this order.
    :param n_workers: number of processes
    :param at_poll: called in the calling process about every half second, and once after the last job
    """
    others = set(multiprocessing.active_children())
    with _pool(n_workers) as pool:
        running: set[Future[Any]] = {pool.submit(job) for job in jobs}
        try:
            while running:
                done, running = wait(running, timeout=POLL_SECONDS)
                at_poll()
                for future in done:
                    future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
            raise


def run_with_restarts(
    function: Callable[[Job], Any], jobs: Iterable[Job], n_workers: int, *, most_deaths: int, final_codes: Collection[int] = ()
) -> Iterator[tuple[Job, int]]:
    """
    Run each job in a process of its own. When the process of a job dies, the job starts again in a new one.

    :param function: the work. It must be picklable, and it must be able to continue what a killed process left.
    :param jobs: the arguments. They start in this order.
    :param n_workers: number of processes at a time, at least one
    :param most_deaths: number of deaths after which a job is given up
    :param final_codes: exit codes other than 0 after which a job does not start again
    :return: each job when it has ended, with the exit code of its last process. Closing the iterator terminates all processes.
    """
    context = multiprocessing.get_context("spawn")
    waiting = deque((job, 0) for job in jobs)
    working: dict[Any, tuple[SpawnProcess, Job, int]] = {}
    try:
        while waiting or working:
            while waiting and len(working) < max(n_workers, 1):
                job, deaths = waiting.popleft()
                process = context.Process(target=_work_on, args=(function, job))
                process.start()
                working[process.sentinel] = process, job, deaths
            for sentinel in wait_for_exit(list(working)):
                process, job, deaths = working.pop(sentinel)
                process.join()
                code: int = process.exitcode  # type: ignore[assignment]
                if code == 0 or code in final_codes or deaths + 1 == most_deaths:
                    yield job, code
                else:
                    waiting.appendleft((job, deaths + 1))
    finally:
        for process, _, _ in working.values():
            process.terminate()


def prepare_worker() -> None:
    """Limit each library that is not loaded yet to one thread, and end this process when its parent is gone."""
    # Software rendering and BLAS each start a thread per core otherwise.
    os.environ.update(LP_NUM_THREADS="1", OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    threading.Thread(target=_follow_parent, daemon=True).start()


def _pool(n_workers: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(n_workers, mp_context=multiprocessing.get_context("spawn"), initializer=prepare_worker)


def _work_on(function: Callable[[Job], Any], job: Job) -> None:
    prepare_worker()
    function(job)


def _follow_parent() -> None:
    """End with the parent. A worker whose parent was killed would otherwise wait for jobs forever: it holds both pipe ends."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        with contextlib.suppress(OSError):
            parent.join()
        os._exit(1)
