"""The runs of a grid on this machine: a process each, one thread each, as many at once as there are cores."""

import multiprocessing
import sys
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from multiprocessing.connection import wait
from typing import Any

from sb3_offline.benchmark.grid import Run
from sb3_offline.benchmark.worker import record_failure, train_run
from sb3_offline.data.errors import DatasetError
from sb3_offline.data_tools.workers import prepare_worker

#: A run whose process is killed so many times has failed: it may need more memory than there is.
MOST_KILLS = 3
_IN_USE = 75  # the exit code of a process that found another one at its run


def train_locally(runs: Iterable[Run], n_workers: int) -> Iterator[Run]:
    """
    :param runs: that are not finished, in the order in which to start them
    :param n_workers: processes; one where fewer are asked for
    :return: each run when it is finished or has failed. Where a process is killed, another goes on with its run, but not for
        ever. Raises ``RuntimeError`` at the end where runs are left to other processes
    """
    context = multiprocessing.get_context("spawn")
    waiting, left = deque(runs), []
    working: dict[Any, tuple[Any, Run]] = {}
    kills: Counter[str] = Counter()
    try:
        while waiting or working:
            while waiting and len(working) < max(n_workers, 1):
                run = waiting.popleft()
                process = context.Process(target=_work, args=(run,))
                process.start()
                working[process.sentinel] = process, run
            for sentinel in wait(list(working)):
                process, run = working.pop(sentinel)
                process.join()
                if process.exitcode == 0:
                    yield run
                    continue
                kills[run.label] += 1
                if process.exitcode == _IN_USE:
                    left.append(run.label)
                elif kills[run.label] < MOST_KILLS:
                    waiting.appendleft(run)
                else:
                    record_failure(run, f"its process died {MOST_KILLS} times, with exit code {process.exitcode}")
                    yield run
    finally:
        for process, _ in working.values():
            process.terminate()
    if left:
        raise RuntimeError(f"Other processes are at these runs: {'; '.join(left)}. Start the same command again afterwards")


def _work(run: Run) -> None:
    prepare_worker()
    try:
        train_run(run)
    except DatasetError as error:
        print(error, file=sys.stderr)
        sys.exit(_IN_USE)
