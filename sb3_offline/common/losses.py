"""Losses of several algorithms, as plain functions of tensors."""

import torch as th


def bellman_loss(values: th.Tensor, targets: th.Tensor) -> th.Tensor:
    """
    ``sum_i E_D[(Q_i(s, a) - y)^2]``.

    :param values: values of the dataset's actions, ``(n_critics, batch)``
    :param targets: y, no gradient, ``(batch,)``
    :return: scalar, summed over the critics
    """
    return (values - targets).pow(2).mean(dim=1).sum()


def expectile_loss(errors: th.Tensor, expectile: float) -> th.Tensor:
    """
    ``E_D[|expectile - 1(u < 0)| u^2]``, which is minimal if the prediction is the expectile of the targets.

    :param errors: u, targets minus predictions, ``(batch,)``
    :param expectile: between 0 and 1; 0.5 gives the mean, 1 the maximum
    :return: scalar
    """
    return (th.abs(expectile - (errors < 0).to(errors.dtype)) * errors.pow(2)).mean()


def effective_share(weights: th.Tensor) -> th.Tensor:
    """
    :param weights: ``(n,)``, positive
    :return: scalar, the share of the weights that would carry as much if all were equal
    """
    return weights.sum() ** 2 / weights.pow(2).sum() / len(weights)
