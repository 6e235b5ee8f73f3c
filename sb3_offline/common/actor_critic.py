"""The base of all algorithms with an actor and critics."""

from typing import ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import get_parameters_by_name, polyak_update

from sb3_offline.common.offline_algorithm import OfflineAlgorithm
from sb3_offline.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, OfflineActor, OfflineCritic, OfflinePolicy
from sb3_offline.common.search import BOOTSTRAPPING, SearchSpace
from sb3_offline.data.buffer import OfflineSamples


class ActorCriticAlgorithm(OfflineAlgorithm):
    """
    The base for algorithms with an actor, critics and target critics.

    :param args: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param kwargs: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    search_space: ClassVar[SearchSpace] = BOOTSTRAPPING
    value_name: ClassVar[str | None] = "Q(s, a)"
    policy: OfflinePolicy
    actor: OfflineActor
    critic: OfflineCritic
    critic_target: OfflineCritic
    critic_parameters: list[th.Tensor]
    critic_target_parameters: list[th.Tensor]
    batch_norm_stats: list[th.Tensor]
    batch_norm_stats_target: list[th.Tensor]

    def _create_aliases(self) -> None:
        super()._create_aliases()
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target
        # Lists, since walking through all modules in each step is slow
        self.critic_parameters = list(self.critic.parameters())
        self.critic_target_parameters = list(self.critic_target.parameters())
        self.batch_norm_stats = get_parameters_by_name(self.critic, ["running_"])
        self.batch_norm_stats_target = get_parameters_by_name(self.critic_target, ["running_"])

    def _policy_features(self, observations: PyTorchObs, features: th.Tensor, rows: th.Tensor | None = None) -> th.Tensor:
        """
        The policy's features: those of its own encoder, or the critic's without their gradient if the two share one.

        :param observations: a batch
        :param features: features of the critic's encoder, ``(batch, features_dim)``
        :param rows: indices into the observations, if ``features`` holds some of them several times
        :return: ``(batch, features_dim)``
        """
        if self.policy.share_features_extractor:
            return features.detach()
        own = self.actor.encode(observations)
        return own if rows is None else own[rows]

    def _values_of_policy(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        The critics' values of the policy's own actions, for the actor's loss. Their gradient reaches the actions only.

        :param features: features of the critic's encoder, ``(batch, features_dim)``
        :param actions: ``(batch, action_dim)`` in [-1, 1]
        :return: ``(n_critics, batch)``
        """
        held = [parameter for parameter in self.critic_parameters if parameter.requires_grad]  # a user may have frozen others
        for parameter in held:  # otherwise their gradients would be computed and thrown away
            parameter.requires_grad_(False)
        try:
            return self.critic.values(features.detach(), actions)
        finally:
            for parameter in held:
                parameter.requires_grad_(True)

    def _update_target(self) -> None:
        if self._n_updates % self.target_update_interval == 0:
            with th.no_grad():
                th._foreach_lerp_(self.critic_target_parameters, self.critic_parameters, self.tau)
            # Running statistics of batch normalisation are copied, as in SB3's SAC.
            polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)

    @th.no_grad()
    def values(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor | None:
        return self.critic.values(self.critic.encode(observations), actions).amin(dim=0)

    @th.no_grad()
    def td_errors(self, batch: OfflineSamples) -> th.Tensor | None:
        discounts = self.gamma * (1 - batch.dones.squeeze(1))
        targets = batch.rewards.squeeze(1) + discounts * self._next_values(batch).amin(dim=0)
        values = self.critic.values(self.critic.encode(batch.observations), batch.actions)
        return (values - targets).abs().mean(dim=0)

    def _next_values(self, batch: OfflineSamples) -> th.Tensor:
        """:return: the target critics' values of the policy's mode in the next observations, ``(n_critics, batch)``"""
        actions = self.policy._predict(batch.next_observations, deterministic=True)  # type: ignore[arg-type]
        return self.critic_target.values(self.critic_target.encode(batch.next_observations), actions)

    def _excluded_save_params(self) -> list[str]:
        critics = [name + suffix for name in ("critic", "critic_target") for suffix in ("", "_parameters")]
        return [*super()._excluded_save_params(), *critics, "batch_norm_stats", "batch_norm_stats_target"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor.optimizer", "critic.optimizer"], []
