"""What Optuna searches: samplers, as ``rl_zoo3`` calls them, for the search spaces of the algorithms."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import optuna
from rl_zoo3.hyperparams_opt import convert_offpolicy_params

from sb3_offline.common.search import SearchSpace


def sample_params(
    space: SearchSpace,
    trial: optuna.Trial,
    n_actions: int,
    n_envs: int,
    additional_args: dict[str, Any],
    policy_kwargs: Mapping[str, Any] = MappingProxyType({}),
) -> dict[str, Any]:
    """
    Draw one trial's hyperparameters. With its space bound, this is a sampler as ``rl_zoo3`` calls it.

    :param space: an algorithm's ``search_space``
    :param trial: the trial
    :param n_actions: not used
    :param n_envs: not used
    :param additional_args: not used
    :param policy_kwargs: the config's, to which the drawn ones are added
    :return: arguments of the algorithm's constructor
    """
    hyperparams = convert_params({name: values.suggest(trial, name) for name, values in space.items()})
    hyperparams["policy_kwargs"] = {**policy_kwargs, **hyperparams["policy_kwargs"]}
    for name in {"gamma", "batch_size"} & hyperparams.keys():
        trial.set_user_attr(name, hyperparams[name])  # the value itself beside what was drawn, as rl_zoo3 does it
    return hyperparams


def convert_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: a trial's hyperparameters, by the names in a ``search_space``
    :return: arguments of the algorithm's constructor
    """
    hyperparams = convert_offpolicy_params({"one_minus_gamma": 0.0, **sampled_params})
    if "one_minus_gamma" not in sampled_params:
        del hyperparams["gamma"]  # this algorithm has no discount
    return hyperparams
