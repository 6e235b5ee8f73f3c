"""
The terms of the paper's Eq. 10 as plain functions of classifier logits. They know no network, optimizer or dataset.

Notation: ``f`` is a critic's logit, ``C = sigmoid(f)`` its probability of success, ``C / (1 - C) = exp(f)`` the odds that
serve as the Q-value. All logits carry the critics as their first axis. Everything is computed in float32 at least.
"""

import math

import torch as th
from torch.nn import functional as F

#: Odds beyond this are out of any use; the bound keeps float32 finite.
OVERFLOW = 1e8


def _full_precision(logits: th.Tensor) -> th.Tensor:
    """bfloat16 has three digits: far too few for a softplus of a saturated logit."""
    return logits if logits.dtype == th.float64 else logits.float()


def success_odds(target_logits: th.Tensor, omega_max: float) -> th.Tensor:
    """
    Eq. 3: ``omega = C / (1 - C)`` at the next step, the smallest of the critics.

    The ratio itself, not its logarithm: Eq. 3 as printed would make labels negative. It is a density ratio and may be far
    above 1, so ``omega_max`` is there against overflow, not to shape values.

    :param target_logits: logits of the target critics at the next state and action, ``(n_critics, batch)``
    :param omega_max: upper bound
    :return: ``(batch,)``
    """
    return _full_precision(target_logits).amin(dim=0).clamp(max=math.log(omega_max)).exp()


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


def advantage_weights(
    odds: th.Tensor,
    state_logits: th.Tensor,
    example_logits: th.Tensor,
    temperature: float,
    advantage_floor: float,
    weight_max: float,
    state_exponent: float = 0.0,
) -> th.Tensor:
    """
    How much more comes of the data's action than of the data's actions on average in its state, times how surely that state
    promises anything: ``((odds(s, a) + eps) / (odds(s) + eps)) ** (1 / temperature) * (odds(s) / (odds(s) + eps)) **
    state_exponent``.

    A ratio, since odds grow by orders of magnitude along a successful trajectory. ``eps`` is a small share of the examples'
    odds. Where both odds are far under it, their ratio is noise, the first factor is about 1, and the second is small; where
    they are above it, the second is about 1: the way to success counts as much as its end.

    :param odds: what comes of dataset actions: learned odds, or the target that they are learned from, ``(batch,)``
    :param state_logits: logits of the classifier that sees the state alone, ``(batch,)``
    :param example_logits: logits of success examples, ``(n_critics, batch)``; the scale of the odds
    :param temperature: the smaller, the sharper
    :param advantage_floor: eps as a share of the examples' mean odds
    :param weight_max: upper bound of the first factor; that of the second is 1
    :param state_exponent: how much less states count that promise little; 0: all states count alike
    :return: ``(batch,)``
    """
    state_odds = success_odds(state_logits.unsqueeze(0), OVERFLOW)
    example_odds = success_odds(example_logits, OVERFLOW).mean()
    eps = advantage_floor * example_odds
    log_ratio = th.log(odds + eps) - th.log(state_odds + eps)
    weights = (log_ratio / temperature).clamp(max=math.log(weight_max)).exp()
    return weights * (state_odds / (state_odds + eps)) ** state_exponent
