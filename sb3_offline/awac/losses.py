"""The weights of AWAC as plain functions of values. They know no network, optimizer or dataset."""

import torch as th


def sampled_advantages(data_values: th.Tensor, policy_values: th.Tensor) -> th.Tensor:
    """
    ``A(s, a) = min_i Q_i(s, a) - V(s)``, where V(s) is the mean of ``min_i Q_i(s, a')`` over actions a' of the policy.

    :param data_values: Q_i of the dataset's actions, ``(n_critics, batch)``
    :param policy_values: Q_i of the policy's actions, ``(n_critics, batch, n_samples)``
    :return: ``(batch,)``
    """
    return data_values.amin(dim=0) - policy_values.amin(dim=0).mean(dim=1)


def softmax_weights(advantages: th.Tensor, temperature: float) -> th.Tensor:
    """
    ``exp(A / temperature)``, divided by its mean over the batch.

    :param advantages: A of the dataset's actions, no gradient, ``(batch,)``
    :param temperature: the smaller, the more the best actions of the batch count
    :return: ``(batch,)``, with the mean 1
    """
    return th.softmax(advantages / temperature, dim=0) * len(advantages)
