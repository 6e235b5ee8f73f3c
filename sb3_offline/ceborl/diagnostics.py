"""A callback that warns of what goes wrong while a classifier of success is trained, and says what to try."""

import math
import warnings
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_offline.ceborl.classifier import RecursiveClassifier
from sb3_offline.ceborl.extraction import WeightedRegression
from sb3_offline.common.callbacks import log_at_once

SATURATED_CLASSIFIER, SATURATED_SHARE = 0.99, 0.5
ON_BOUNDS, COLLAPSED_SHARE = 0.98, 0.5
CLIPPED_SHARE = 0.01
EFFECTIVE_TRANSITIONS = 100

_REMEDIES = {
    "classifier_saturated": (
        "C is above {saturated} on {classifier_saturated:.0%} of the data: the classifier takes most of it for success, and "
        "the gradient of the penalty, C (1 - C), is gone. Try, in this order: backup='dataset' and initial_odds=0.01 (the "
        "defaults); example_share=0.02; policy_kwargs={{'critic_layer_norm': True}}; data with more failures"
    ),
    "omega_clipped": (
        "The target's odds are at their bound of {omega_max:g} for {omega_clipped:.0%} of the data: the values run away (odds "
        "of 20 to 60 are normal). If the classifier is saturated, see there. Otherwise try n_steps=10 or a smaller tau"
    ),
    "actions_on_bounds": (
        "The policy sits on the bounds of the action space, with {actions_on_bounds:.0%} of its actions' entries against "
        "{data_actions_on_bounds:.0%} of the data's: it exploits the classifier where there are no data. Try "
        "policy_extraction='weighted' and backup='dataset' (the defaults); otherwise a higher ent_coef, mu='mixture', or "
        "policy_kwargs={{'std_min': 0.05}}"
    ),
    "domain_gap": (
        "After {steps} steps the classifier tells all examples from each of {n_transitions} states of the data. Either the "
        "data hold no success, or it looks at something else: another camera, light, crop or preprocessing; other objects; "
        "entries of a vector that differ from episode to episode. Look at both side by side, and take the examples in the "
        "set-up of the data. For images try random_shift=4. For vectors raise the floor under the standard deviations: "
        "policy_kwargs={{'features_extractor_kwargs': {{'std_min': 0.1}}}}"
    ),
    "weights_collapsed": (
        "The policy imitates as much as {effective_transitions:.0f} transitions of the {n_kept} that it draws from: its "
        "weights are too sharp. Raise temperature (now {temperature:g})"
    ),
}


class DiagnosticsCallback(BaseCallback):
    """
    Watches CEBORL or RCE while they learn. It warns once of each of these problems and names a remedy to try:

    - the classifier saturates: it predicts success for most of the data
    - omega reaches its bound
    - the actor collapses onto the bounds of the action space
    - the classifier tells the examples from the data at once, which indicates a domain gap instead of success
    - the weighted regression imitates only a few transitions

    It draws its transitions with its own generator, so a run with the callback equals a run without it. It logs its
    measurements under ``diagnostics/``.

    :param check_freq: gradient steps between two checks
    :param n_transitions: number of transitions that are checked, beside all examples
    :param early_steps: last step at which examples that are perfectly told from the data count as a domain gap. Later, a
        classifier may know all of its examples by heart
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    """

    model: RecursiveClassifier

    def __init__(self, check_freq: int = 500, n_transitions: int = 1024, early_steps: int = 2000, verbose: int = 0):
        super().__init__(verbose)
        self.check_freq, self.n_transitions, self.early_steps = check_freq, n_transitions, early_steps
        self.warned: set[str] = set()
        self._rng = np.random.default_rng(0)

    def _init_callback(self) -> None:
        if not isinstance(self.model, RecursiveClassifier):
            raise TypeError(f"DiagnosticsCallback is for CEBORL and RCE, not for {type(self.model).__name__}")

    def _on_step(self) -> bool:
        if self.num_timesteps % self.check_freq == 0:
            found = self.measure()
            log_at_once(self, {f"diagnostics/{name}": value for name, value in found.items()})
            self._judge(found)
        return True

    @th.no_grad()
    def measure(self) -> dict[str, float]:
        """
        :return: what is logged: shares between 0 and 1
        """
        model, buffer = self.model, self.model.replay_buffer
        batch = buffer.transitions(self._rng.integers(buffer.size(), size=self.n_transitions), model._vec_normalize_env)
        model.policy.set_training_mode(False)  # train() sets it again
        features = model.critic.encode(batch.observations)
        logits = model.critic.values(features, batch.actions).mean(dim=0)
        target_logits = model.critic_target.values(model.critic_target.encode(batch.observations), batch.actions)
        actions, values = self._policy_values(batch.observations, features)
        examples = model.all_examples()
        example_features = model.critic.encode(examples)
        if model.examples_lack_keys:  # the policy cannot be asked for its actions there
            actions_there = model.some_data_actions(len(example_features))
            example_values = model.critic.values(example_features, actions_there).mean(dim=0).float()
        else:
            _, example_values = self._policy_values(examples, example_features)
        found = {
            "classifier_saturated": logits.sigmoid() > SATURATED_CLASSIFIER,
            "omega_clipped": target_logits.amin(dim=0) >= math.log(model.omega_max),
            "actions_on_bounds": actions.abs() > ON_BOUNDS,
            "data_actions_on_bounds": batch.actions.abs() > ON_BOUNDS,
            "data_like_examples": values >= example_values.quantile(0.01),
        }
        return {name: float(hits.float().mean()) for name, hits in found.items()}

    def _policy_values(self, observations: Any, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """The policy's modes, and the classifier's logits of these: for examples, the data's actions are not known."""
        mean, _ = self.model.actor.gaussian_parameters(self.model._policy_features(observations, features))
        actions = th.tanh(mean)
        return actions, self.model.critic.values(features, actions).mean(dim=0).float()

    def _judge(self, found: dict[str, float]) -> None:
        more = found["actions_on_bounds"] - found["data_actions_on_bounds"]
        n_kept, effective_transitions = 0, math.inf
        extraction = self.model._extraction
        if isinstance(extraction, WeightedRegression):
            n_kept = int((extraction.pool.weights > 0).sum())
            effective_transitions = float(extraction.pool.effective_share()) * n_kept
        wrong = {
            "classifier_saturated": found["classifier_saturated"] > SATURATED_SHARE,
            "omega_clipped": found["omega_clipped"] > CLIPPED_SHARE,
            "actions_on_bounds": found["actions_on_bounds"] > COLLAPSED_SHARE and more > COLLAPSED_SHARE / 2,
            "domain_gap": found["data_like_examples"] == 0 and self.num_timesteps <= self.early_steps,
            # Before that, few transitions have a weight at all
            "weights_collapsed": effective_transitions < EFFECTIVE_TRANSITIONS <= n_kept / 10,
        }
        about = {
            **found,
            **{name: getattr(self.model, name, None) for name in ("omega_max", "temperature")},
            "saturated": SATURATED_CLASSIFIER,
            "effective_transitions": effective_transitions,
            "n_kept": n_kept,
            "steps": self.num_timesteps,
            "n_transitions": self.n_transitions,
        }
        for name, is_wrong in wrong.items():
            if is_wrong and name not in self.warned:
                self.warned.add(name)
                warnings.warn(f"Step {self.num_timesteps}: {_REMEDIES[name].format(**about)}.", stacklevel=2)
