"""A callback that evaluates a model on held-out data."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import VecNormalize

from sb3_offline.common.callbacks import log_at_once
from sb3_offline.common.example_based import ExampleBasedAlgorithm, ExamplesLike
from sb3_offline.common.normalization import normalize_parts
from sb3_offline.common.offline_algorithm import OfflineAlgorithm
from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.examples import load_examples
from sb3_offline.data.reader import DatasetLike
from sb3_offline.evaluation.fitted_q import batches_of, first_steps, fitted_q_evaluation, state_values
from sb3_offline.evaluation.metrics import judge_probabilities, success_to_come


class OfflineEvalCallback(BaseCallback):
    """
    Evaluates a model without an environment. It logs the measures that apply to the model under ``offline_eval/``:

    - ``td_error``: mean absolute error of the learned policy's Bellman equation (for CEBORL and RCE, of the recursion of their
      probabilities). An error that is small on the training data and large on held-out data indicates overfitting; a growing
      error indicates divergence.
    - ``initial_value``, ``initial_value_std``: mean and standard deviation of the critic's values of the episodes' first
      states (for CEBORL and RCE, of the logits of C). A mean far above ``data_return``, the mean discounted return of the
      episodes, indicates overestimation.
    - ``examples_accuracy``, ``_auc``, ``_calibration_error``: how well a classifier of success tells held-out examples from
      held-out data, with equal weight for both
    - ``success_accuracy``, ``_auc``, ``_calibration_error``: how well it tells states from which the episode goes on to
      succeed from all others, if the dataset has success labels
    - ``fqe_value``: the policy's discounted return by :func:`~sb3_offline.evaluation.fitted_q.fitted_q_evaluation`

    A run with this callback equals a run without it.

    :param dataset: held-out data with the same spaces; default: the data that the model learns from
    :param examples: held-out success examples, for learners from examples
    :param eval_freq: gradient steps between two evaluations
    :param n_transitions: number of transitions to evaluate on, the same ones each time
    :param fqe_steps: gradient steps of each fitted Q evaluation (0: none), which needs rewards
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    """

    model: OfflineAlgorithm

    def __init__(
        self,
        dataset: DatasetLike | None = None,
        examples: ExamplesLike | None = None,
        eval_freq: int = 1000,
        n_transitions: int = 4096,
        fqe_steps: int = 0,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        self.dataset, self.examples = dataset, examples
        self.eval_freq, self.n_transitions, self.fqe_steps = eval_freq, n_transitions, fqe_steps

    def _on_training_start(self) -> None:
        model = self.model
        if self.dataset is None:
            self.buffer = model.replay_buffer.single_steps()
        else:
            self.buffer = OfflineReplayBuffer(
                self.dataset,
                model.observation_space,
                model.action_space,
                model.device,
                gamma=model.gamma,
                n_stack=model.n_stack,
            )
            model.relabel(self.buffer)
        size = self.buffer.size()
        n = min(self.n_transitions, size)
        self.indices = np.sort(np.random.default_rng(0).choice(size, size=n, replace=False))
        self.example_observations: PyTorchObs | None = None
        if self.examples is not None:
            arrays: Any
            if isinstance(model, ExampleBasedAlgorithm):  # it knows their keys, and how many frames it stacks
                arrays = model.load_examples(self.examples)
            else:
                arrays = load_examples(self.examples, model.observation_space)
            if model._vec_normalize_env is not None:
                arrays = normalize_parts(model._vec_normalize_env, arrays)
            if isinstance(arrays, dict):
                self.example_observations = {key: th.as_tensor(array, device=model.device) for key, array in arrays.items()}
            else:
                self.example_observations = th.as_tensor(arrays, device=model.device)

    def _on_step(self) -> bool:
        if self.n_calls % self.eval_freq == 0:
            log_at_once(self, {f"offline_eval/{name}": value for name, value in self.evaluate().items()})
        return True

    def evaluate(self) -> dict[str, float]:
        """
        :return: the measures by name, without the prefix
        """
        model: Any = self.model  # only models with a critic are asked for it
        model.policy.set_training_mode(False)  # train() sets it again
        found: dict[str, float] = {}
        if model.value_name is not None:
            initial = state_values(model.critic, model, self.buffer, first_steps(self.buffer))
            found |= {"initial_value": float(initial.mean()), "initial_value_std": float(initial.std())}
            batches = batches_of(self.buffer, self.indices, model._vec_normalize_env)
            found["td_error"] = float(np.concatenate([_numpy(model.td_errors(batch)) for batch in batches]).mean())
        found |= self._judge_classifier()
        if self.buffer.has_rewards:
            found["data_return"] = float(discounted_returns(self.buffer, model.gamma, model._vec_normalize_env).mean())
            if self.fqe_steps:
                found["fqe_value"] = float(fitted_q_evaluation(model, self.buffer, self.fqe_steps).mean())
        return found

    def _judge_classifier(self) -> dict[str, float]:
        """:return: how well the model's classifier of success does; nothing if it has none"""
        found: dict[str, float] = {}
        probabilities = []
        for batch in batches_of(self.buffer, self.indices, self.model._vec_normalize_env):
            of_batch = self.model.success_probabilities(batch.observations, batch.actions)
            if of_batch is None:
                return found
            probabilities.append(_numpy(of_batch))
        of_data = np.concatenate(probabilities)
        if self.example_observations is not None:
            of_examples = _numpy(self.model.success_probabilities(self.example_observations))
            labels = np.append(np.ones(len(of_examples), dtype=bool), np.zeros(len(of_data), dtype=bool))
            judged = judge_probabilities(np.append(of_examples, of_data), labels)
            found |= {f"examples_{name}": value for name, value in judged.items()}
        datasets = self.buffer.datasets
        if all(dataset.success is not None for dataset in datasets):
            labels = np.concatenate([success_to_come(np.asarray(d.success), d.lengths) for d in datasets])[self.indices]
            if labels.any() and not labels.all():
                found |= {f"success_{name}": value for name, value in judge_probabilities(of_data, labels).items()}
        return found


def _numpy(tensor: th.Tensor | None) -> np.ndarray:
    assert tensor is not None
    return tensor.float().cpu().numpy()


def discounted_returns(buffer: OfflineReplayBuffer, gamma: float, env: VecNormalize | None = None) -> np.ndarray:
    """
    :param buffer: a buffer with rewards
    :param gamma: the discount factor
    :param env: normalises rewards
    :return: (E,) the discounted return of each episode
    """
    starts = first_steps(buffer)
    lengths = np.diff(np.append(starts, buffer.size()))
    discounts = gamma ** (np.arange(buffer.size()) - np.repeat(starts, lengths))
    return np.add.reduceat(buffer._normalize_reward(buffer.rewards, env) * discounts, starts)
