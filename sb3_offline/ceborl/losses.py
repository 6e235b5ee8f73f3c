"""
The terms of the paper's Eq. 10 as plain functions of classifier logits, without networks, optimizers or datasets.

Notation: ``f`` is a critic's logit, ``C = sigmoid(f)`` its probability of success, ``C / (1 - C) = exp(f)`` the odds that
serve as the Q-value. All logits carry the critics as their first axis. Everything is computed in float32 at least.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch as th
from torch.nn import functional as F

#: Bound of odds that keeps float32 finite. Larger odds are meaningless.
OVERFLOW = 1e8

#: Smallest distance of a mean probability from 0 and 1 before its logit is taken
PROBABILITY_EPSILON = 1e-7


def _full_precision(logits: th.Tensor) -> th.Tensor:
    """bfloat16 has three digits: far too few for a softplus of a saturated logit."""
    return logits if logits.dtype == th.float64 else logits.float()


def success_odds(target_logits: th.Tensor, omega_max: float) -> th.Tensor:
    """
    Eq. 3: ``omega = C / (1 - C)`` at the next step, the lowest of the critics.

    Omega is the ratio itself and not its logarithm, as Eq. 3 is printed, which would make labels negative. As a density ratio
    it may be far above 1; ``omega_max`` only prevents overflow and is not meant to shape values.

    :param target_logits: logits of the target critics at the next state and action, ``(n_critics, batch)``
    :param omega_max: upper bound
    :return: ``(batch,)``
    """
    return _full_precision(target_logits).amin(dim=0).clamp(max=math.log(omega_max)).exp()


def mean_of_odds(target_logits: Sequence[th.Tensor], discounts: Sequence[th.Tensor], omega_max: float) -> th.Tensor:
    """
    ``gamma * omega`` over several horizons: the mean of their discounted odds.

    :param target_logits: logits of the target critics after each horizon, ``(n_critics, batch)`` each
    :param discounts: ``gamma ** n`` of each horizon, ``(batch,)`` each
    :param omega_max: upper bound of the odds
    :return: ``(batch,)``
    """
    discounted = [d * success_odds(logits, omega_max) for d, logits in zip(discounts, target_logits, strict=True)]
    return sum(discounted[1:], start=discounted[0]) / len(discounted)


def odds_of_mean_probability(
    target_logits: Sequence[th.Tensor], discounts: Sequence[th.Tensor], gamma: float, omega_max: float
) -> th.Tensor:
    """
    ``gamma * omega`` over several horizons, as the authors of RCE take it: the odds of the mean *probability*. For 1 and n
    steps: ``omega = Cbar / (1 - Cbar)``, ``Cbar = (C(s_1, a_1) + gamma ** n C(s_n, a_n)) / 2``.

    :param target_logits: logits of the target critics after each horizon, the 1-step one first, ``(n_critics, batch)`` each
    :param discounts: ``gamma ** n`` of each horizon, ``(batch,)`` each
    :param gamma: discount factor
    :param omega_max: upper bound of the odds
    :return: ``(batch,)``
    """
    if len(target_logits) == 1:  # the odds themselves: a probability near 1 is rounded in float32
        return discounts[0] * success_odds(target_logits[0], omega_max)
    one_step, *longer = (logits.sigmoid() for logits in target_logits)
    total = sum((d * c for d, c in zip(discounts[1:], longer, strict=True)), start=one_step)
    return gamma * success_odds(th.logit(total / len(target_logits), eps=PROBABILITY_EPSILON), omega_max)


def episode_outcomes(probabilities: np.ndarray, lengths: np.ndarray, gamma: float) -> np.ndarray:
    """
    The discounted success in the rest of each episode: ``max_k gamma ** k * p(s_{t+1+k})``.

    This is omega of Eq. 3 without bootstrapping. The paper reads the odds as the probability of success in the discounted
    future (Eq. 7), and an episode of the dataset shows how that future went.

    :param probabilities: (N,) probability that the observation after each step shows success
    :param lengths: (E,) number of steps of each episode, N in all
    :param gamma: discount factor
    :return: (N,) float32 between 0 and 1
    """
    ends = np.cumsum(lengths)
    best, outcomes = np.zeros(len(lengths)), np.empty(len(probabilities), np.float32)
    for back in range(1, int(lengths.max(initial=0)) + 1):  # all episodes at once, from their last steps to their first
        longer = np.flatnonzero(lengths >= back)
        steps = ends[longer] - back
        best[longer] = np.maximum(probabilities[steps], gamma * best[longer])
        outcomes[steps] = best[longer]
    return outcomes


def conservative_penalty(data_logits: th.Tensor, sampled_logits: th.Tensor, penalty_space: str = "probability") -> th.Tensor:
    """
    Term (a) without its ``beta``: ``E_mu[C(s, a)] - E_D[C(s, a)]``, the first as a log-mean-exp over K sampled actions.

    :param data_logits: logits of dataset actions, ``(n_critics, batch)``
    :param sampled_logits: logits of K actions from mu at the same states, ``(n_critics, batch, K)``
    :param penalty_space: penalise the ``"probability"`` C, as the paper does, or the ``"logit"`` f
    :return: scalar, summed over the critics
    """
    data, sampled = _full_precision(data_logits), _full_precision(sampled_logits)
    if penalty_space == "probability":
        data, sampled = data.sigmoid(), sampled.sigmoid()
    soft_maximum = th.logsumexp(sampled, dim=-1) - math.log(sampled.shape[-1])
    return (soft_maximum - data).mean(dim=1).sum()


def example_loss(example_logits: th.Tensor, gamma: float, class_prior: float = 1.0) -> th.Tensor:
    """
    Term (b): ``(1 - gamma) E_{s in S*, a ~ pi}[CE(C(s, a); y = 1)]``.

    :param example_logits: logits of success examples with the policy's actions, ``(n_critics, batch)``
    :param gamma: discount factor
    :param class_prior: weight of the examples, p(e = 1); the paper drops it (1.0), which scales all odds by its inverse
    :return: scalar, summed over the critics
    """
    return (1.0 - gamma) * class_prior * F.softplus(-_full_precision(example_logits)).mean(dim=1).sum()


def recursive_loss(data_logits: th.Tensor, discounted_omega: th.Tensor) -> th.Tensor:
    """
    Term (c): ``E_D[(1 + gamma omega) CE(C(s, a); y = gamma omega / (1 + gamma omega))]``.

    The weight and the label multiply out to ``gamma omega softplus(-f) + softplus(f)``.

    :param data_logits: logits of dataset actions, ``(n_critics, batch)``
    :param discounted_omega: ``gamma * omega``, no gradient, ``(batch,)``
    :return: scalar, summed over the critics
    """
    logits = _full_precision(data_logits)
    return (discounted_omega * F.softplus(-logits) + F.softplus(logits)).mean(dim=1).sum()


def odds_ratio_weights(
    odds: th.Tensor,
    state_logits: th.Tensor,
    success: th.Tensor,
    temperature: float,
    advantage_floor: float,
    promise_floor: float,
    weight_max: float,
    exponent: float,
) -> th.Tensor:
    """
    Advantage weights of the dataset's actions: the odds of the action over the odds of its state, times how promising both
    are: ``((odds(s, a) + eps) / (odds(s) + eps)) ** (1 / temperature) * (share(odds(s, a)) share(odds(s))) ** exponent``,
    with ``share(x) = x / (x + delta)``.

    The advantage is a ratio because odds grow by orders of magnitude along a successful trajectory. ``eps`` and ``delta`` are
    small shares of the odds of success. Where both odds are far below ``eps``, their ratio is noise: the first factor is about
    1, and the second is small. Where both are above ``delta``, the second factor is about 1, so the way to success counts as
    much as its end. Without the second factor, failures would have most of the weight where most episodes pass through,
    such as their common start.

    :param odds: outcomes of the dataset's actions: learned odds, or the targets that they are learned from, ``(batch,)``
    :param state_logits: logits of the classifier that sees the state alone, ``(batch,)``
    :param success: the odds of success itself, which set the scale of the odds, scalar
    :param temperature: the smaller, the sharper the weights
    :param advantage_floor: eps as a share of the odds of success
    :param promise_floor: delta as a share of the odds of success
    :param weight_max: upper bound of the first factor; the second is at most 1
    :param exponent: how much less unpromising states and outcomes count; 0: all count alike
    :return: ``(batch,)``
    """
    state_odds = success_odds(state_logits.unsqueeze(0), OVERFLOW)
    eps, delta = advantage_floor * success, promise_floor * success
    log_ratio = th.log(odds + eps) - th.log(state_odds + eps)
    weights = (log_ratio / temperature).clamp(max=math.log(weight_max)).exp()
    return weights * (odds / (odds + delta) * state_odds / (state_odds + delta)) ** exponent
