"""Compare methods over all tasks with rliable: interquartile means and probabilities of improvement."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from rliable import library, metrics

from sb3_offline.report.results import Results

REPETITIONS = 1000


@dataclass(frozen=True)
class Estimate:
    """
    An estimate and its uncertainty.

    :param value: the estimate
    :param interval: 95 % interval of a bootstrap over the seeds within each task; ``None`` if there is only one seed
    """

    value: float
    interval: tuple[float, float] | None

    def __str__(self) -> str:
        return f"{self.value:.2f}" + (f" ({self.interval[0]:.2f} to {self.interval[1]:.2f})" if self.interval else "")


def scores(results: Results) -> dict[str, np.ndarray]:
    """
    :param results: results of a grid
    :return: for each method that has run on all tasks, its ``(seeds, tasks)`` success rates
    """
    return {
        method: np.array([[results.entries[method, task].by("seed")[seed].rate for task in results.tasks] for seed in seeds])
        for method in results.methods
        if (seeds := results.seeds(method))
    }


def interquartile_means(results: Results) -> dict[str, Estimate]:
    """
    :param results: results of a grid
    :return: for each method, the mean of the middle half of its runs over seeds and tasks
    """
    own = scores(results)
    return _estimates(own, lambda rates: np.array([metrics.aggregate_iqm(rates)]), own)


def improvement_probabilities(results: Results, reference: str) -> dict[str, Estimate]:
    """
    :param results: results of a grid
    :param reference: name of a method
    :return: for each other method, the probability that a run of the reference does better on a task, averaged over the tasks
    """
    own = scores(results)
    pairs = {other: (own[reference], own[other]) for other in own if other != reference and reference in own}
    return _estimates(pairs, metrics.probability_of_improvement, own)


def _estimates(samples: dict[str, Any], statistic: Callable[..., Any], own: dict[str, np.ndarray]) -> dict[str, Estimate]:
    if not samples:
        return {}
    state = np.random.get_state()
    np.random.seed(0)  # rliable draws from NumPy's global generator, and each report should be the same
    try:
        points, intervals = library.get_interval_estimates(samples, statistic, reps=REPETITIONS)
    finally:
        np.random.set_state(state)
    found = {}
    for name in samples:
        low, high = np.ravel(intervals[name])
        parts = samples[name] if isinstance(samples[name], tuple) else (own[name],)
        several = all(len(part) > 1 for part in parts)  # a single seed cannot be resampled
        found[name] = Estimate(float(np.ravel(points[name])[0]), (float(low), float(high)) if several else None)
    return found
