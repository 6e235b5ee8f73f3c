"""Several networks on the same features."""

from collections.abc import Iterable, Sequence

import torch as th
from torch import nn

from sb3_offline.common.fast.layers import linear, mlp
from sb3_offline.common.fast.operators import is_eager


def linear_heads(trunk: Iterable[nn.Module], heads: Sequence[nn.Linear], x: th.Tensor) -> tuple[th.Tensor, ...]:
    """
    Compute ``head(trunk(x))`` for each of several heads, with one product for all of them.

    :param trunk: the layers before the heads
    :param heads: linear layers, with or without biases, all alike
    :param x: ``(rows, in_features)``
    :return: of each head, ``(rows, out_features)``, in the dtype of the heads' weights
    """
    weight = th.cat([head.weight for head in heads])
    bias = None if heads[0].bias is None else th.cat([head.bias for head in heads])
    return mlp([*trunk, (weight, bias)], x).split([head.out_features for head in heads], dim=1)


def state_action_values(q_networks: Sequence[nn.Sequential], features: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """
    Compute the outputs of critics, for one action or for many actions of each state.

    With many actions, the first layer is split into a product with the features, once a state, and one with the actions,
    once an action. Only their sum has a row for each action.

    :param q_networks: networks that map features and actions, side by side, to one value; their first and last layers are
        linear
    :param features: ``(batch, features_dim)``
    :param actions: ``(batch, action_dim)``, or ``(batch, K, action_dim)``
    :return: ``(n_critics, batch)``, or ``(n_critics, batch, K)``, in the dtype of the networks' parameters
    """
    actions = actions.to(features.dtype)
    if actions.dim() == 2:
        pairs = th.cat([features, actions], dim=1)
        return th.stack([mlp(q_net, pairs).squeeze(1) for q_net in q_networks])
    if not is_eager():
        pairs = th.cat([features.unsqueeze(1).expand(-1, actions.shape[1], -1), actions], dim=2)
        return th.stack([mlp(q_net, pairs).squeeze(2) for q_net in q_networks])
    samples = actions.transpose(0, 1)  # (K, batch, .): what depends on states alone is added along whole rows
    outputs = []
    for q_net in q_networks:
        first, *others = q_net
        assert isinstance(first, nn.Linear)
        state_weight, action_weight = first.weight.split([features.shape[1], actions.shape[-1]], dim=1)
        of_state = linear(features, state_weight, first.bias)
        outputs.append(mlp([(action_weight, of_state), *others], samples.flatten(0, 1)).view(samples.shape[:2]))
    return th.stack(outputs).transpose(1, 2)
