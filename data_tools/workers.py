"""Independent jobs over worker processes, their results in order."""

import contextlib
import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from typing import TypeVar

Job = TypeVar("Job")
Result = TypeVar("Result")
AHEAD = 4
"""Jobs given out for each worker: enough to keep it busy, few enough for their results to wait in memory."""


def map_in_order(function: Callable[[Job], Result], jobs: Iterable[Job], n_workers: int) -> Iterator[Result]:
    """
    :param function: can be pickled; what it keeps (``functools.lru_cache``) stays in its worker
    :param jobs: taken one by one, when a worker will soon be free
    :param n_workers: processes; with 1 the jobs run in this one
    :return: the results in the order of the jobs
    """
    if n_workers <= 1:
        yield from map(function, jobs)
        return
    waiting: deque[Future[Result]] = deque()
    pool = ProcessPoolExecutor(n_workers, mp_context=multiprocessing.get_context("spawn"), initializer=prepare_worker)
    try:
        for job in jobs:
            waiting.append(pool.submit(function, job))
            if len(waiting) == AHEAD * n_workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def prepare_worker() -> None:
    """Keep this process to one thread of each library that it has not loaded yet, and end it when its parent is gone."""
    # Software rendering and BLAS each start a thread for every core otherwise.
    os.environ.update(LP_NUM_THREADS="1", OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    """A worker whose parent was killed would wait for jobs for ever: it holds both ends of their pipe."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        with contextlib.suppress(OSError):
            parent.join()
        os._exit(1)
