"""
Backups: the value of the next step in the recursion, from which omega of Eq. 3 is made.

A backup is a small object that says what it needs of the dataset and of the critic, and gives the target critics' logits in
the observations that transitions lead to. It has no state of its own.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_offline.ceborl.losses import mean_of_odds, odds_of_mean_probability
from sb3_offline.common.losses import expectile_loss
from sb3_offline.data.buffer import Horizon


class Learner(Protocol):
    """What backups ask of their model."""

    actor: Any
    critic: Any
    critic_target: Any
    expectile: float
    gamma: float
    omega_max: float


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

    def target_logits(self, observations: PyTorchObs, features: th.Tensor, horizons: Sequence[Horizon]) -> th.Tensor:
        """
        :param observations: the observations after each horizon, one horizon after the other, shifted as in training
        :param features: the target critic's features of these, ``(len(horizons) * batch, features_dim)``
        :param horizons: the horizons
        :return: the target's logits there, ``(n, len(horizons) * batch)``, from n critics
        """
        raise NotImplementedError

    def discounted_omega(self, logits: Sequence[th.Tensor], horizons: Sequence[Horizon]) -> th.Tensor:
        """
        :param logits: the target's logits after each horizon, ``(n, batch)`` each
        :param horizons: the horizons
        :return: ``gamma * omega`` of Eq. 3: the mean of the horizons' discounted odds, ``(batch,)``
        """
        return mean_of_odds(logits, _discounts(horizons), self.model.omega_max)

    def state_loss(self, observations: PyTorchObs, features: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        The loss of the head of states, of backups that have ``fits_state_head``.

        :param observations: a batch
        :param features: the critic's features of it, ``(batch, features_dim)``
        :param actions: the dataset's actions, ``(batch, action_dim)``
        :return: the head's logits, ``(batch,)``, and the loss, a scalar
        """
        raise NotImplementedError


def _discounts(horizons: Sequence[Horizon]) -> list[th.Tensor]:
    return [horizon.discounts.squeeze(1) for horizon in horizons]


class PolicyBackup(Backup):
    """``a' ~ pi(s')``: the paper's Eq. 3. Over two horizons, omega is made of the mean probability, as RCE's authors do."""

    def target_logits(self, observations: PyTorchObs, features: th.Tensor, horizons: Sequence[Horizon]) -> th.Tensor:
        actions, _ = self.model.actor.sample(self.model.actor.encode(observations))
        return self.model.critic_target.values(features, actions)  # type: ignore[no-any-return]

    def discounted_omega(self, logits: Sequence[th.Tensor], horizons: Sequence[Horizon]) -> th.Tensor:
        return odds_of_mean_probability(logits, _discounts(horizons), self.model.gamma, self.model.omega_max)


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

    def target_logits(self, observations: PyTorchObs, features: th.Tensor, horizons: Sequence[Horizon]) -> th.Tensor:
        return self.model.critic_target.state_values(features).unsqueeze(0)  # type: ignore[no-any-return]

    def discounted_omega(self, logits: Sequence[th.Tensor], horizons: Sequence[Horizon]) -> th.Tensor:
        """
        :param logits: the target's logits after each horizon, ``(n, batch)`` each
        :param horizons: the horizons
        :return: ``gamma * omega`` of Eq. 3: the mean of the horizons' discounted odds, ``(batch,)``
        """
        return mean_of_odds(logits, _discounts(horizons), self.model.omega_max)

    def state_loss(self, observations: PyTorchObs, features: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        model = self.model
        state_logits = model.critic.state_values(features)
        with th.no_grad():
            target_logits = model.critic_target.values(model.critic_target.encode(observations), actions)
        return state_logits, expectile_loss(target_logits.amin(dim=0) - state_logits, model.expectile)


#: By the names that ``backup`` takes.
BACKUPS: dict[str, type[Backup]] = {"dataset": DatasetBackup, "policy": PolicyBackup, "expectile": ExpectileBackup}
