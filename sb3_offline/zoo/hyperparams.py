"""What Optuna searches, for each algorithm: the spaces that ``python -m sb3_offline.zoo.train -optimize`` draws from."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import optuna
from rl_zoo3.hyperparams_opt import convert_offpolicy_params

Suggestion = Callable[[optuna.Trial, str], Any]


def _log(low: float, high: float) -> Suggestion:
    return lambda trial, name: trial.suggest_float(name, low, high, log=True)


def _uniform(low: float, high: float) -> Suggestion:
    return lambda trial, name: trial.suggest_float(name, low, high)


def _integer(low: int, high: int) -> Suggestion:
    return lambda trial, name: trial.suggest_int(name, low, high)


def _choice(*values: str | int | float | None) -> Suggestion:
    return lambda trial, name: trial.suggest_categorical(name, values)


# Names as rl_zoo3 has them: `batch_size_pow` is the power of 2, `net_arch` the name of a size.
_LEARNING = {
    "learning_rate": _log(1e-5, 2e-3),
    "batch_size_pow": _integer(5, 10),
    "net_arch": _choice("small", "medium", "big"),
}
_BOOTSTRAPPING = {
    **_LEARNING,
    "one_minus_gamma": _log(1e-3, 0.1),
    "tau": _log(1e-3, 0.08),
    "n_steps": _choice(1, 3, 10),
}
_CQL = {**_BOOTSTRAPPING, "cql_alpha": _log(0.05, 20)}

#: By algorithm: names of hyperparameters, and what to suggest for each.
SPACES: dict[str, dict[str, Suggestion]] = {
    "awac": {**_BOOTSTRAPPING, "temperature": _log(0.1, 10), "n_action_samples": _choice(1, 4, 10)},
    "bc": {**_LEARNING, "loss": _choice("mse", "log_prob")},
    "ceborl": {
        **_BOOTSTRAPPING,
        "beta": _log(1e-2, 1),
        "temperature": _log(0.1, 1),
        "example_share": _uniform(0, 0.1),
        "initial_odds": _log(1e-3, 1),
        "state_exponent": _uniform(0, 4),
    },
    "cql": _CQL,
    "dcql": {**_CQL, "ent_coef": _log(1e-5, 0.1), "distance": _choice("l2", "mse"), "reward_scale": _log(1e-3, 10)},
    "iql": {**_BOOTSTRAPPING, "expectile": _uniform(0.5, 0.95), "inverse_temperature": _log(0.5, 10)},
    "oril": {
        **_CQL,
        "ent_coef": _log(1e-5, 0.1),
        "reward_learning_rate": _log(1e-5, 1e-3),
        "positive_prior": _choice(None, 0.1, 0.3, 0.5),
    },
    "rce": {**_BOOTSTRAPPING, "ent_coef": _log(1e-5, 0.1), "example_share": _uniform(0, 0.1)},
    "rebrac": {**_BOOTSTRAPPING, "actor_bc_coef": _log(1e-3, 1), "critic_bc_coef": _log(1e-4, 1)},
    "td3_bc": {
        **_BOOTSTRAPPING,
        "alpha": _log(0.5, 10),
        "policy_delay": _integer(1, 3),
        "target_policy_noise": _uniform(0, 0.5),
    },
}


def sample_params(
    space: dict[str, Suggestion],
    trial: optuna.Trial,
    n_actions: int,
    n_envs: int,
    additional_args: dict[str, Any],
    policy_kwargs: Mapping[str, Any] = MappingProxyType({}),
) -> dict[str, Any]:
    """
    A sampler as ``rl_zoo3`` calls it, once its space is bound.

    :param space: one of :data:`SPACES`
    :param trial: that asks for a suggestion
    :param n_actions: not used
    :param n_envs: not used
    :param additional_args: not used
    :param policy_kwargs: of the config, to which those that are drawn are added
    :return: arguments of the algorithm's constructor
    """
    hyperparams = convert_params({name: suggest(trial, name) for name, suggest in space.items()})
    hyperparams["policy_kwargs"] = {**policy_kwargs, **hyperparams["policy_kwargs"]}
    for name in {"gamma", "batch_size"} & hyperparams.keys():
        trial.set_user_attr(name, hyperparams[name])  # the value itself beside what was drawn, as rl_zoo3 does it
    return hyperparams


def convert_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: of a trial, by the names in :data:`SPACES`
    :return: arguments of the algorithm's constructor
    """
    hyperparams = convert_offpolicy_params({"one_minus_gamma": 0.0, **sampled_params})
    if "one_minus_gamma" not in sampled_params:
        del hyperparams["gamma"]  # of an algorithm that knows no discount
    return hyperparams
