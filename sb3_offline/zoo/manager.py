"""The one place where a run of rl_zoo3 differs for offline algorithms: what its config means."""

import argparse
from functools import partial
from typing import Any

from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER
from stable_baselines3.common.base_class import BaseAlgorithm

import sb3_offline
from sb3_offline.common.offline_algorithm import OfflineAlgorithm
from sb3_offline.data.examples import load_examples
from sb3_offline.data.reader import open_datasets
from sb3_offline.experiment.config import config_path, number_or_text, python_value
from sb3_offline.experiment.data import resolve_data
from sb3_offline.experiment.training import learns_from_examples
from sb3_offline.zoo.hyperparams import sample_params


class OfflineExperimentManager(ExperimentManager):
    """
    ``rl_zoo3``'s experiment manager, for the configs of this package as well:

    - The config of an offline algorithm is by default the shipped one; ``config`` may be the name of another shipped one.
    - ``dataset``, ``examples`` and ``episodes`` of a config mean what they mean to ``sb3-offline train``, and what is wrong
      with them is said before a run begins.
    - The network that a trial of Optuna draws is added to the config's ``policy_kwargs``, in place of replacing them all.
    - The ``env_kwargs`` that were given are added to the config's, in place of replacing them all, and the environment of the
      evaluations has them too.

    :param args: parsed arguments of the program; its ``env_kwargs`` become the ones that are used, for ``enjoy``
    :param algo: name of the algorithm
    :param rest: see ``rl_zoo3``
    :param kwargs: see ``rl_zoo3``
    """

    def __init__(self, args: argparse.Namespace, algo: str, *rest: Any, **kwargs: Any):
        self._drawn_policy_kwargs: dict[str, Any] = {}
        super().__init__(args, algo, *rest, **kwargs)
        config = config_path(kwargs.get("config") or algo)
        if algo in sb3_offline.ALGOS and config.is_file():
            self.config = str(config)

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        given, self.env_kwargs = self.env_kwargs, {}
        hyperparams, saved_hyperparams = super().read_hyperparameters()
        if self.algo in sb3_offline.ALGOS:
            hyperparams = {name: number_or_text(value) for name, value in hyperparams.items()}
            if self._drawn_policy_kwargs:
                own = hyperparams.get("policy_kwargs", {})
                own = python_value(own) if isinstance(own, str) else own
                hyperparams["policy_kwargs"] = {**own, **self._drawn_policy_kwargs}
            if "n_stack" in hyperparams:  # the Zoo stacks frames of training and evaluation by its own name for it
                hyperparams["frame_stack"] = hyperparams.pop("n_stack")
                saved_hyperparams.pop("n_stack", None)
            saved_hyperparams.update(hyperparams)
        env_kwargs = {**hyperparams.get("env_kwargs", {}), **given}
        hyperparams["env_kwargs"] = saved_hyperparams["env_kwargs"] = self.args.env_kwargs = env_kwargs
        self.eval_env_kwargs = {**env_kwargs, **(self._eval_env_kwargs_args or {})}
        return hyperparams, saved_hyperparams

    def load_trial(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        drawn = super().load_trial(*args, **kwargs)
        if self.algo in sb3_offline.ALGOS:
            self._drawn_policy_kwargs = drawn.pop("policy_kwargs", {})
        return drawn

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> tuple:
        if self.algo in sb3_offline.ALGOS:
            hyperparams = resolve_data(hyperparams, hyperparams["env_kwargs"], learns_from_examples(self.algo))
            if hyperparams.get("dataset") is None:
                remedy = "add `dataset:` to it, or give --hyperparams \"dataset:'my_data.h5'\""
                raise RuntimeError(f"{self.config}: names no dataset for {self.env_name.gym_id}; {remedy}")
            datasets = open_datasets(hyperparams["dataset"])
            if hyperparams.get("examples") is not None:
                load_examples(hyperparams["examples"], datasets[0].observation_space, hyperparams.get("example_keys"))
        hyperparams, *rest = super()._preprocess_hyperparams(hyperparams)
        if self.algo in sb3_offline.ALGOS:
            if self.frame_stack is not None:
                hyperparams["n_stack"] = self.frame_stack
            policy_kwargs = hyperparams.setdefault("policy_kwargs", {})
            HYPERPARAMS_SAMPLER[self.algo] = partial(
                sample_params, sb3_offline.ALGOS[self.algo].search_space, policy_kwargs=policy_kwargs
            )
        return hyperparams, *rest

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        try:
            return super().setup_experiment()
        except (TypeError, ValueError) as error:
            raise RuntimeError(f"{self.algo}: {error}; check the config and --hyperparams") from error

    def learn(self, model: BaseAlgorithm) -> None:
        if isinstance(model, OfflineAlgorithm):
            self.callbacks += model.default_callbacks()
        super().learn(model)
