"""Train the runs of a grid on this machine, in one process of one thread each."""

import sys
from collections.abc import Iterable, Iterator

from sb3_offline.benchmark.grid import GridRun
from sb3_offline.benchmark.worker import complete_run, record_failure
from sb3_offline.data.errors import DatasetError
from sb3_offline.parallel.processes import run_with_restarts

MOST_DEATHS = 3
"""Number of times a run's process may die before the run counts as failed: it may need more memory than there is."""
_IN_USE = 75  # exit code of a process whose run another process is training


def train_locally(runs: Iterable[GridRun], n_workers: int) -> Iterator[GridRun]:
    """
    Train runs. When a process is killed, another one continues its run, up to :data:`MOST_DEATHS` times.

    :param runs: unfinished runs; they start in this order
    :param n_workers: number of processes at a time, at least one
    :return: each run when it is finished or has failed; raises ``RuntimeError`` at the end if other processes train some of
        the runs
    """
    left = []
    for run, code in run_with_restarts(_work, runs, n_workers, most_deaths=MOST_DEATHS, final_codes=[_IN_USE]):
        if code == _IN_USE:
            left.append(run.label)
            continue
        if code != 0:
            record_failure(run, f"its process died {MOST_DEATHS} times, with exit code {code}")
        yield run
    if left:
        raise RuntimeError(f"Other processes train these runs: {'; '.join(left)}. Start the same command again afterwards")


def _work(run: GridRun) -> None:
    try:
        complete_run(run)
    except DatasetError as error:
        print(error, file=sys.stderr)
        sys.exit(_IN_USE)
