"""Losses that several algorithms share, as plain functions."""

import torch as th


def bellman_loss(values: th.Tensor, targets: th.Tensor) -> th.Tensor:
    """
    ``sum_i E_D[(Q_i(s, a) - y)^2]``.

    :param values: of dataset actions, ``(n_critics, batch)``
    :param targets: y, no gradient, ``(batch,)``
    :return: scalar, summed over the critics
    """
    return (values - targets).pow(2).mean(dim=1).sum()
