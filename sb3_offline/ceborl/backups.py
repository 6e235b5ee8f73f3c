"""
Backups: the value of the next step in the recursion, from which omega of Eq. 3 is made.

A backup is a small object that says what it needs of the dataset and of the critic, and gives each transition's omega.
"""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Protocol

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_offline.ceborl.losses import (
    OVERFLOW,
    episode_outcomes,
    mean_of_odds,
    odds_of_mean_probability,
    recursive_loss,
    success_odds,
)
from sb3_offline.common.augmentation import has_images
from sb3_offline.common.losses import expectile_loss
from sb3_offline.data.buffer import Horizon, OfflineReplayBuffer, OfflineSamples, Pairs, joined
from sb3_offline.data.examples import Observations, examples_checksum
from sb3_offline.labelling.classifier import ClassifierSettings, success_probabilities

#: Passes over the data after which a classifier of states has seen enough of them
DETECTOR_PASSES = 50


class Learner(Protocol):
    """What backups ask of their model."""

    actor: Any
    critic: Any
    critic_target: Any
    augment: Any
    gamma: float
    omega_max: float
    read_examples: Any
    replay_buffer: Any
    seed: Any
    _record: Any
    _vec_normalize_env: Any


class Backup:
    """
    The base of all backups.

    :param model: the model that learns with this backup
    """

    #: whether the dataset's action in the next observation is used
    needs_next_actions: ClassVar[bool] = False
    #: whether :meth:`state_loss` fits the critic's head of states; otherwise the head, if any, learns as one more classifier
    fits_state_head: ClassVar[bool] = False

    def __init__(self, model: Learner):
        self.model = model

    def sample(self, batch_size: int) -> OfflineSamples | Pairs:
        """
        :param batch_size: number of transitions
        :return: a batch, with what :meth:`discounted_omega` needs of it
        """
        return self.model.replay_buffer.sample(batch_size, env=self.model._vec_normalize_env)  # type: ignore[no-any-return]

    def discounted_omega(self, batch: Any) -> th.Tensor:
        """
        :param batch: transitions, from :meth:`sample`
        :return: ``gamma * omega`` of Eq. 3, the positive weight of each transition in term (c), no gradient, ``(batch,)``
        """
        model, horizons = self.model, batch.horizons
        successors = joined([model.augment(horizon.observations) for horizon in horizons])
        logits = self.target_logits(successors, model.critic_target.encode(successors), horizons)
        model._record(omega_clipped=(logits.amin(dim=0) >= math.log(model.omega_max)).float().mean())
        return self.odds(logits.chunk(len(horizons), dim=1), [horizon.discounts.squeeze(1) for horizon in horizons])

    def target_logits(self, observations: PyTorchObs, features: th.Tensor, horizons: Sequence[Horizon]) -> th.Tensor:
        """
        :param observations: the observations after each horizon, one horizon after the other, shifted as in training
        :param features: the target critic's features of these, ``(len(horizons) * batch, features_dim)``
        :param horizons: the horizons
        :return: the target's logits there, ``(n, len(horizons) * batch)``, from n critics
        """
        raise NotImplementedError

    def odds(self, logits: Sequence[th.Tensor], discounts: Sequence[th.Tensor]) -> th.Tensor:
        """
        :param logits: the target's logits after each horizon, ``(n, batch)`` each
        :param discounts: ``gamma ** n`` of each horizon, ``(batch,)`` each
        :return: the discounted odds over all horizons, ``(batch,)``
        """
        return mean_of_odds(logits, discounts, self.model.omega_max)

    def start(self, buffer: OfflineReplayBuffer) -> None:
        """
        Called when the data are open.

        :param buffer: the dataset
        """

    def get_state(self) -> Any:
        """:return: what a saved model keeps; ``None`` if there is nothing"""
        return None

    def set_state(self, state: Any) -> None:
        """:param state: what :meth:`get_state` of the saved model returned"""

    def example_omega(self, examples: PyTorchObs, rows: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param examples: success examples, shifted as in training
        :param rows: for each place in the batch its row in the examples, ``(example batch,)``
        :param actions: the policy's actions there, ``(example batch, action_dim)``
        :return: ``gamma * omega`` of the examples as their own successors, ``(example batch,)``
        """
        target = self.model.critic_target
        return self.model.gamma * success_odds(target.values(target.encode(examples)[rows], actions), self.model.omega_max)

    def success_odds(self, example_logits: th.Tensor) -> th.Tensor:
        """
        :param example_logits: logits of the success examples, ``(n_critics, example batch)``
        :return: the odds of success itself, the scale of all odds, scalar
        """
        return success_odds(example_logits, OVERFLOW).mean()

    def state_loss(
        self, observations: PyTorchObs, features: th.Tensor, actions: th.Tensor, discounted_omega: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        The loss of the head of states, of backups that have ``fits_state_head``.

        :param observations: a batch
        :param features: the critic's features of it, ``(batch, features_dim)``
        :param actions: the dataset's actions, ``(batch, action_dim)``
        :param discounted_omega: what :meth:`discounted_omega` gave, ``(batch,)``
        :return: the head's logits, ``(batch,)``, and the loss, a scalar
        """
        raise NotImplementedError


class PolicyBackup(Backup):
    """``a' ~ pi(s')``: the paper's Eq. 3. Over two horizons, omega is made of the mean probability, as RCE's authors do."""

    def target_logits(self, observations: PyTorchObs, features: th.Tensor, horizons: Sequence[Horizon]) -> th.Tensor:
        actions, _ = self.model.actor.sample(self.model.actor.encode(observations))
        return self.model.critic_target.values(features, actions)  # type: ignore[no-any-return]

    def odds(self, logits: Sequence[th.Tensor], discounts: Sequence[th.Tensor]) -> th.Tensor:
        return odds_of_mean_probability(logits, discounts, self.model.gamma, self.model.omega_max)


class DatasetBackup(Backup):
    """``a'`` is the dataset's own next action, so no value of an unseen action is asked for."""

    needs_next_actions = True

    def target_logits(self, observations: PyTorchObs, features: th.Tensor, horizons: Sequence[Horizon]) -> th.Tensor:
        actions = th.cat([horizon.next_actions for horizon in horizons])  # type: ignore[misc]
        return self.model.critic_target.values(features, actions)  # type: ignore[no-any-return]


class ExpectileBackup(Backup):
    """No action: a state's odds are an upper expectile of the logits of the dataset's actions in it, as in IQL."""

    needs_next_actions = True
    fits_state_head = True
    #: 0.5 is the mean, near 1 the best of the dataset's actions
    expectile: float = 0.9

    def target_logits(self, observations: PyTorchObs, features: th.Tensor, horizons: Sequence[Horizon]) -> th.Tensor:
        return self.model.critic_target.state_values(features).unsqueeze(0)  # type: ignore[no-any-return]

    def state_loss(
        self, observations: PyTorchObs, features: th.Tensor, actions: th.Tensor, discounted_omega: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        model = self.model
        state_logits = model.critic.state_values(features)
        with th.no_grad():
            target_logits = model.critic_target.values(model.critic_target.encode(observations), actions)
        return state_logits, expectile_loss(target_logits.amin(dim=0) - state_logits, self.expectile)


class EpisodeBackup(Backup):
    """
    Nothing is bootstrapped: omega is the discounted success in the rest of the dataset's own episode, which a classifier of
    states detects. The classifier is trained on the examples when the data are opened.
    """

    fits_state_head = True

    def __init__(self, model: Learner):
        super().__init__(model)
        self.outcomes: th.Tensor | None = None  # (transitions,), gamma * omega
        self.made_of: tuple[float, ...] = ()  # identifies what the outcomes were computed of: data, examples, discount

    def start(self, buffer: OfflineReplayBuffer) -> None:
        model = self.model
        examples = model.read_examples()
        made_of = (buffer.checksum(), examples_checksum(examples), model.gamma)
        if made_of != self.made_of:
            success = success_probabilities(buffer, examples, _detector(buffer, examples), seed=model.seed or 0)
            outcomes = model.gamma * episode_outcomes(success.after, success.lengths, model.gamma)
            self.outcomes, self.made_of = th.as_tensor(outcomes), made_of
        assert self.outcomes is not None
        self.outcomes = self.outcomes.to(buffer.device)

    def get_state(self) -> Any:
        return None if self.outcomes is None else (self.outcomes.cpu(), self.made_of)

    def set_state(self, state: Any) -> None:
        self.outcomes, self.made_of = state

    def sample(self, batch_size: int) -> Pairs:
        return self.model.replay_buffer.sample_pairs(batch_size, env=self.model._vec_normalize_env)  # type: ignore[no-any-return]

    def discounted_omega(self, batch: Pairs) -> th.Tensor:
        assert self.outcomes is not None
        return self.outcomes[batch.indices.to(self.outcomes.device)]

    def example_omega(self, examples: PyTorchObs, rows: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return actions.new_full((len(actions),), self.model.gamma)

    def success_odds(self, example_logits: th.Tensor) -> th.Tensor:
        return example_logits.new_full((), self.model.gamma)

    def state_loss(
        self, observations: PyTorchObs, features: th.Tensor, actions: th.Tensor, discounted_omega: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        state_logits = self.model.critic.state_values(features)
        return state_logits, recursive_loss(state_logits.unsqueeze(0), discounted_omega)


def _detector(buffer: OfflineReplayBuffer, examples: Observations) -> ClassifierSettings:
    """:return: how to train the classifier of states: less long from images, where a network takes minutes, and on few data"""
    n_examples = len(next(iter(examples.values())) if isinstance(examples, dict) else examples)
    steps, batch_size = (300, 128) if has_images(buffer.observation_space) else (1000, 256)
    steps = min(steps, 1 + DETECTOR_PASSES * buffer.size() // batch_size)
    n_models = min(2, n_examples, len(buffer.lengths))
    return ClassifierSettings(n_models=n_models, gradient_steps=steps, batch_size=batch_size)


#: By the names that ``backup`` takes.
BACKUPS: dict[str, type[Backup]] = {
    "dataset": DatasetBackup,
    "policy": PolicyBackup,
    "expectile": ExpectileBackup,
    "episode": EpisodeBackup,
}
