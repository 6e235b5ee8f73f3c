"""Several training runs at once, one thread each: small networks gain more from that than from a second thread."""

import functools
import multiprocessing
import queue
from collections.abc import Mapping
from concurrent.futures import Future, ProcessPoolExecutor, wait
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from tqdm.auto import tqdm

REPORT_INTERVAL = 20
POLL_SECONDS = 0.5


class _ReportProgress(BaseCallback):
    """Tells the parent process how far this run is."""

    def __init__(self, reports: Any, label: str):
        super().__init__()
        self.reports, self.label = reports, label

    def _on_step(self) -> bool:
        parent = multiprocessing.parent_process()
        if parent is not None and not parent.is_alive():
            raise SystemExit("the process that asked for this run is gone")
        if self.num_timesteps % REPORT_INTERVAL == 0 or self.num_timesteps == self.model._total_timesteps:
            self.reports.put((self.label, self.num_timesteps))
        return True


def _run(label: str, arguments: dict[str, Any], reports: Any) -> None:
    # Imported here: a worker first has to know that it may use one thread only.
    th.set_num_threads(1)
    from sb3_offline.experiment.training import train

    train(**arguments, progress_bar=False, callbacks=[_ReportProgress(reports, label)])


def train_in_parallel(runs: Mapping[str, dict[str, Any]], n_workers: int) -> None:
    """
    Where a run fails, the others are stopped and its error is raised.

    :param runs: label to the arguments of :func:`~sb3_offline.experiment.training.train`; they are started in this order
    :param n_workers: processes
    """
    if not runs:
        return
    context, others = multiprocessing.get_context("spawn"), set(multiprocessing.active_children())
    reports = context.Manager().Queue()
    bars: dict[str, tqdm] = {}
    with ProcessPoolExecutor(n_workers, mp_context=context) as pool:
        running: set[Future] = {
            pool.submit(functools.partial(_run, label, arguments, reports)) for label, arguments in runs.items()
        }
        try:
            while running:
                done, running = wait(running, timeout=POLL_SECONDS)
                _show(reports, bars, runs)
                for future in done:
                    future.result()  # raises what went wrong in there, without waiting for the others
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
            raise
    for bar in bars.values():
        bar.close()


def _show(reports: Any, bars: dict[str, tqdm], runs: Mapping[str, dict[str, Any]]) -> None:
    """A bar for each run that has begun; it closes when its run is through, which makes room for the next."""
    while True:
        try:
            label, step = reports.get_nowait()
        except queue.Empty:
            return
        total = runs[label]["config"]["n_timesteps"]
        if label not in bars:
            bars[label] = tqdm(total=total, desc=label, unit="step")
        bars[label].update(step - bars[label].n)
        if step >= total:
            bars[label].close()
