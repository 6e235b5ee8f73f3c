"""How well probabilities separate two classes, and how well they are calibrated."""

import numpy as np

N_BINS = 10


def judge_probabilities(probabilities: np.ndarray, labels: np.ndarray) -> dict[str, float]:
    """
    :param probabilities: (n,) in [0, 1]
    :param labels: (n,) bool, of both classes; both have the same weight
    :return: ``accuracy`` (balanced, at 0.5), ``auc`` (0.5: chance), ``calibration_error`` (mean distance between the
        probability and the observed frequency, over ten bins of equal width)
    """
    weights = np.where(labels, 0.5 / labels.sum(), 0.5 / (~labels).sum())
    accuracy = (weights * ((probabilities > 0.5) == labels)).sum()
    bins = np.minimum((probabilities * N_BINS).astype(int), N_BINS - 1)
    gaps = np.bincount(bins, weights * (probabilities - labels), N_BINS)
    return {"accuracy": float(accuracy), "auc": auc(probabilities, labels), "calibration_error": float(np.abs(gaps).sum())}


def auc(scores: np.ndarray, labels: np.ndarray) -> float:
    """
    :param scores: (n,)
    :param labels: (n,) bool, of both classes
    :return: the probability that a positive scores above a negative; ties count half
    """
    _, inverse, counts = np.unique(scores, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - (counts - 1) / 2)[inverse]
    n_positive, n_negative = labels.sum(), (~labels).sum()
    return float((ranks[labels].sum() - n_positive * (n_positive + 1) / 2) / (n_positive * n_negative))


def success_to_come(success: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """
    :param success: (N,) bool, success after each step, of all episodes one after the other
    :param lengths: (E,) steps of each episode
    :return: (N,) bool, whether the episode succeeds at this step or at a later one
    """
    counts = np.cumsum(success)
    return np.repeat(counts[np.cumsum(lengths) - 1], lengths) - counts + success > 0
