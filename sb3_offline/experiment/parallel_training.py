"""Several training runs at once, with one thread each: small networks gain more from that than from a second thread."""

import functools
import queue
from collections.abc import Mapping
from multiprocessing import get_context
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from tqdm.auto import tqdm

from sb3_offline.experiment.run import TrainingRun
from sb3_offline.experiment.training import train_run
from sb3_offline.parallel.processes import run_all

REPORT_INTERVAL = 20


class _ReportProgress(BaseCallback):
    """Tells the parent process the current step of this run."""

    def __init__(self, reports: Any, label: str):
        super().__init__()
        self.reports, self.label = reports, label

    def _on_step(self) -> bool:
        if self.num_timesteps % REPORT_INTERVAL == 0 or self.num_timesteps == self.model._total_timesteps:
            self.reports.put((self.label, self.num_timesteps))
        return True


def _train(label: str, run: TrainingRun, reports: Any) -> None:
    th.set_num_threads(1)
    train_run(run, progress_bar=False, callbacks=[_ReportProgress(reports, label)])


def train_in_parallel(runs: Mapping[str, TrainingRun], n_workers: int) -> None:
    """
    Train several runs with a progress bar each. As soon as one of them fails, the others are stopped and its error is raised.

    :param runs: runs by label; they start in this order
    :param n_workers: number of processes
    """
    if not runs:
        return
    bars: dict[str, tqdm] = {}
    with get_context("spawn").Manager() as manager:
        reports = manager.Queue()
        jobs = [functools.partial(_train, label, run, reports) for label, run in runs.items()]
        run_all(jobs, n_workers, functools.partial(_show, reports, bars, runs))
    for bar in bars.values():
        bar.close()


def _show(reports: Any, bars: dict[str, tqdm], runs: Mapping[str, TrainingRun]) -> None:
    """Show a bar for each run that has begun. It closes when its run ends, which makes room for the next one."""
    while True:
        try:
            label, step = reports.get_nowait()
        except queue.Empty:
            return
        total = runs[label].config["n_timesteps"]
        if label not in bars:
            bars[label] = tqdm(total=total, desc=label, unit="step")
        bars[label].update(step - bars[label].n)
        if step >= total:
            bars[label].close()
