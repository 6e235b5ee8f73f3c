"""From logits to probabilities, without labels."""

from typing import NamedTuple

import numpy as np

#: Shares of the examples that lie below the thresholds of :func:`share_of_successes`
EXAMPLE_QUANTILES = np.linspace(0.02, 0.25, 24)
#: Probability that the upper bound of a share, counted in examples, does not hold
BOUND_FAILS = 0.05
#: Pulls the slope to 1, so that it stays finite where a threshold separates all examples from all failures
SLOPE_PENALTY = 1e-3


class Calibration(NamedTuple):
    """
    Turns logits into probabilities of success.

    :param slope: factor of a logit
    :param offset: is added to it
    :param positive_share: estimated share of the data's observations that show success
    """

    slope: float
    offset: float
    positive_share: float

    def __call__(self, logits: np.ndarray) -> np.ndarray:
        """
        :param logits: (n,) of observations of the data
        :return: (n,) float32, probabilities of success
        """
        return _sigmoid(self.slope * logits.astype(np.float64) + self.offset).astype(np.float32)


def calibrate(example_logits: np.ndarray, data_logits: np.ndarray, weights: np.ndarray | None = None) -> Calibration:
    """
    Fit a logistic regression of "success or failure" on logits of networks that saw neither these examples nor these data.
    No datum is labelled, but a share eta of the data looks like the examples, so the cross-entropy over successes and
    failures is known nevertheless: it is ``E_D[softplus(f)] - eta E_E[f]``, which is convex in slope and offset
    (https://proceedings.mlr.press/v37/plessis15.html). At its minimum, the data's mean probability is eta.

    :param example_logits: (n,) of success examples
    :param data_logits: (m,) of observations of the data
    :param weights: (m,) weights of the data (default: equal)
    :return: the calibration
    """
    examples, data = example_logits.astype(np.float64), data_logits.astype(np.float64)
    weights = np.ones(len(data)) if weights is None else weights
    share = share_of_successes(examples, data, weights)
    slope, offset = _positive_unlabelled_regression(examples, data, weights / weights.sum(), share)
    return Calibration(slope, offset, share)


def share_of_successes(example_logits: np.ndarray, data_logits: np.ndarray, weights: np.ndarray) -> float:
    """
    Estimate the share of the data that looks like the examples. Above any threshold lie a known share of the examples and as
    large a share of the data's successes, so that the data's share above it, divided by the examples', bounds the wanted
    share from above. The lowest bound is the estimate (best bin estimation, https://arxiv.org/abs/2111.00980). Only low
    thresholds are tried, with most of the examples above them: then the estimate also holds where the data's successes look
    otherwise spread than the examples, as pictures that a person took do.

    :param example_logits: (n,) of success examples
    :param data_logits: (m,) of observations of the data
    :param weights: (m,) weights of the data
    :return: the share
    """
    thresholds = np.quantile(example_logits, EXAMPLE_QUANTILES)
    examples = np.array([(example_logits >= threshold).mean() for threshold in thresholds])
    data = np.array([weights[data_logits >= threshold].sum() for threshold in thresholds]) / weights.sum()
    # Few examples lie above a high threshold, and their share is known less well
    margins = np.sqrt(np.log(1 / BOUND_FAILS) / (2 * len(example_logits)))
    best = np.argmin(data / examples * (1 + margins / examples))
    return float(np.clip(data[best] / examples[best], 1 / weights.sum(), 1 - 1 / weights.sum()))


def _positive_unlabelled_regression(
    examples: np.ndarray, data: np.ndarray, weights: np.ndarray, share: float, steps: int = 100
) -> tuple[float, float]:
    """:return: slope and offset, by Newton's method"""
    design = np.stack([data, np.ones_like(data)], axis=1)
    wanted = share * np.array([examples.mean(), 1.0])
    penalty = SLOPE_PENALTY * share * np.diag([1.0, 0.0])
    parameters = np.array([1.0, np.log(share / (1 - share)) - np.quantile(examples, 0.1)])
    for _ in range(steps):
        p = _sigmoid(design @ parameters)
        gradient = design.T @ (weights * p) - wanted + penalty @ (parameters - [1.0, 0.0])
        hessian = (design * (weights * p * (1 - p))[:, None]).T @ design + penalty + 1e-9 * np.eye(2)
        step = np.linalg.solve(hessian, gradient)
        parameters = parameters - step * min(1.0, 1 / max(np.abs(step).max(), 1e-12))
        if np.abs(step).max() < 1e-8:
            break
    return max(float(parameters[0]), 0.0), float(parameters[1])


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-np.clip(x, -60, 60)))
