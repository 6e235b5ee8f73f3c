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
        if self.num_timesteps % REPORT_INTERVAL == 0:
            self.reports.put((self.label, self.num_timesteps))
        return True


def _run(label: str, arguments: dict[str, Any], reports: Any) -> None:
    # Imported here: a worker first has to know that it may use one thread only.
    th.set_num_threads(1)
    from sb3_offline.experiment.training import train

    train(**arguments, progress_bar=False, callback=_ReportProgress(reports, label))


def train_in_parallel(runs: Mapping[str, dict[str, Any]], n_workers: int) -> None:
    """
    :param runs: label to the arguments of :func:`~sb3_offline.experiment.training.train`; they are started in this order
    :param n_workers: processes
    """
    context = multiprocessing.get_context("spawn")
    reports = context.Manager().Queue()
    bars = {
        label: tqdm(total=arguments["config"]["n_timesteps"], desc=label, unit="step", position=position)
        for position, (label, arguments) in enumerate(runs.items())
    }
    with ProcessPoolExecutor(n_workers, mp_context=context) as pool:
        futures: list[Future] = [
            pool.submit(functools.partial(_run, label, arguments, reports)) for label, arguments in runs.items()
        ]
        try:
            while not all(future.done() for future in futures):
                wait(futures, timeout=POLL_SECONDS)
                _show(reports, bars)
                for future in futures:
                    if future.done():
                        future.result()  # raises what went wrong in there, without waiting for the others
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise
    for label, bar in bars.items():
        bar.update(runs[label]["config"]["n_timesteps"] - bar.n)
        bar.close()


def _show(reports: Any, bars: dict[str, tqdm]) -> None:
    while True:
        try:
            label, step = reports.get_nowait()
        except queue.Empty:
            return
        bars[label].update(step - bars[label].n)
