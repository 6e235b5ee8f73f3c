"""Small files that hold the weights of an actor, and nothing else of a model."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy

from sb3_offline.common.offline_algorithm import OfflineAlgorithm
from sb3_offline.common.stub_env import SpacesOnlyEnv
from sb3_offline.data.files import replacing
from sb3_offline.data.spaces import space_from_json, space_to_json
from sb3_offline.experiment.training import create_model

_DESCRIPTION = "description"
_UNIT = ":unit"
_KEPT = ("algo", "env", "env_kwargs", "seed", "n_timesteps", "policy", "policy_kwargs")


def save_policy(path: Path, model: OfflineAlgorithm, config: dict[str, Any]) -> None:
    """
    Save the actor of a model. Matrices take one byte per weight, a quarter of their size: weights are rounded to multiples of
    a unit, which each row has for itself.

    :param path: the ``.npz`` file
    :param model: the model
    :param config: record of its run, as :func:`~sb3_offline.experiment.training.load_run` returns it
    """
    weights = {name: value.cpu().numpy() for name, value in model.actor.state_dict().items()}
    for name in [name for name, parameter in model.actor.named_parameters() if parameter.dim() > 1]:
        unit = np.abs(weights[name]).max(axis=tuple(range(1, weights[name].ndim)), keepdims=True).clip(1e-12) / 127
        weights[name], weights[name + _UNIT] = (weights[name] / unit).round().astype(np.int8), unit
    description = {
        **{key: config[key] for key in _KEPT if key in config},
        **({"n_stack": model.n_stack} if model.n_stack > 1 else {}),
        "observation_space": space_to_json(model.observation_space),
        "action_space": space_to_json(model.action_space),
    }
    with replacing(path) as temporary, temporary.open("wb") as file:
        arrays: dict[str, Any] = {**weights, _DESCRIPTION: np.array(json.dumps(description))}
        np.savez_compressed(file, **arrays)


def load_policy(path: Path) -> tuple[BasePolicy, dict[str, Any]]:
    """
    :param path: a file of :func:`save_policy`
    :return: a policy that plays nearly as the model did, with an untrained critic; and the record of its run
    """
    try:
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        config = json.loads(str(arrays.pop(_DESCRIPTION)))
        spaces = [space_from_json(config.pop(name)) for name in ("observation_space", "action_space")]
        algo, *_ = config["algo"], config["env"], config["env_kwargs"]
    except (OSError, EOFError, KeyError, ValueError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        raise RuntimeError(f"{path}: is not a policy file of sb3-offline benchmark --policies ({error})") from error
    kwargs = {key: config[key] for key in ("policy", "policy_kwargs") if key in config}
    model = create_model(algo, kwargs, dataset=None, env=SpacesOnlyEnv(*spaces))
    for name in [name for name in arrays if name + _UNIT in arrays]:
        arrays[name] = arrays[name] * arrays.pop(name + _UNIT)
    model.policy.n_stack = config.get("n_stack", 1)  # the number of frames that whoever plays it has to stack
    model.actor.load_state_dict({name: th.as_tensor(array) for name, array in arrays.items()})
    return model.policy, config
