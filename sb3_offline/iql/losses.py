"""The losses of IQL as plain functions of values. They know no network, optimizer or dataset."""

import math

import torch as th


def advantage_weights(advantages: th.Tensor, inverse_temperature: float, weight_max: float) -> th.Tensor:
    """
    ``min(exp(inverse_temperature * A), weight_max)``.

    :param advantages: A = Q(s, a) - V(s), no gradient, ``(batch,)``
    :param inverse_temperature: the larger, the sharper
    :param weight_max: upper bound
    :return: ``(batch,)``
    """
    return (inverse_temperature * advantages).clamp(max=math.log(weight_max)).exp()
