"""The losses of IQL as plain functions of values, without networks, optimizers or datasets."""

import math

import torch as th


def exponential_weights(advantages: th.Tensor, inverse_temperature: float, weight_max: float) -> th.Tensor:
    """
    Advantage weights of the dataset's actions: ``min(exp(inverse_temperature * A), weight_max)``.

    :param advantages: A = Q(s, a) - V(s), no gradient, ``(batch,)``
    :param inverse_temperature: the larger, the sharper
    :param weight_max: upper bound
    :return: ``(batch,)``
    """
    return (inverse_temperature * advantages).clamp(max=math.log(weight_max)).exp()
