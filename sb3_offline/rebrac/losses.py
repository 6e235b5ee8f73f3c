"""The two penalties of ReBRAC as plain functions of values and actions. They know no network, optimizer or dataset."""

import torch as th


def squared_distances(actions: th.Tensor, data_actions: th.Tensor) -> th.Tensor:
    """
    ``|pi(s) - a|^2``, summed over the dimensions of an action.

    :param actions: of the policy, ``(batch, action_dim)``
    :param data_actions: of the dataset, ``(batch, action_dim)``
    :return: ``(batch,)``
    """
    return (actions - data_actions).pow(2).sum(dim=1)


def penalized_values(next_values: th.Tensor, distances: th.Tensor, bc_coef: float) -> th.Tensor:
    """
    ``min_i Qbar_i(s', a') - bc_coef |a' - a'_D|^2``: what the critics' targets are made of.

    :param next_values: of the target policy's actions a', the smallest of the critics, ``(batch,)``
    :param distances: squared, between a' and the dataset's next actions a'_D, ``(batch,)``
    :param bc_coef: weight of the penalty
    :return: ``(batch,)``
    """
    return next_values - bc_coef * distances


def penalized_actor_loss(values: th.Tensor, distances: th.Tensor, bc_coef: float) -> th.Tensor:
    """
    ``E_D[bc_coef |pi(s) - a|^2 - lambda Q(s, pi(s))]`` with ``lambda = 1 / E_D|Q(s, pi(s))|``, which has no gradient.

    :param values: Q of the policy's actions, the smallest of the critics, ``(batch,)``
    :param distances: squared, between the policy's and the dataset's actions, ``(batch,)``
    :param bc_coef: weight of the penalty
    :return: scalar
    """
    return (bc_coef * distances - values / values.abs().mean().detach()).mean()
