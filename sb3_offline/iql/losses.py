"""The losses of IQL as plain functions of values. They know no network, optimizer or dataset."""

import math

import torch as th


def expectile_loss(errors: th.Tensor, expectile: float) -> th.Tensor:
    """
    ``E_D[|expectile - 1(u < 0)| u^2]``: minimal where the prediction is the expectile of the targets.

    :param errors: u, targets minus predictions, ``(batch,)``
    :param expectile: between 0 and 1; 0.5 gives the mean, 1 the maximum
    :return: scalar
    """
    return (th.abs(expectile - (errors < 0).to(errors.dtype)) * errors.pow(2)).mean()


def advantage_weights(advantages: th.Tensor, inverse_temperature: float, weight_max: float) -> th.Tensor:
    """
    ``min(exp(inverse_temperature * A), weight_max)``.

    :param advantages: A = Q(s, a) - V(s), no gradient, ``(batch,)``
    :param inverse_temperature: the larger, the sharper
    :param weight_max: upper bound
    :return: ``(batch,)``
    """
    return (inverse_temperature * advantages).clamp(max=math.log(weight_max)).exp()
