"""What all algorithms with an actor and critics share."""

from typing import ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import get_parameters_by_name, polyak_update

from sb3_offline.common.offline_algorithm import OfflineAlgorithm
from sb3_offline.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, OfflineActor, OfflineCritic, OfflinePolicy


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
        # Lists, since a walk through all modules in each step takes a while
        self.critic_parameters = list(self.critic.parameters())
        self.critic_target_parameters = list(self.critic_target.parameters())
        self.batch_norm_stats = get_parameters_by_name(self.critic, ["running_"])
        self.batch_norm_stats_target = get_parameters_by_name(self.critic_target, ["running_"])

    def _policy_features(self, observations: PyTorchObs, features: th.Tensor, rows: th.Tensor | None = None) -> th.Tensor:
        """
        The critic's features, which the policy does not train; or the policy's own, where it has an encoder of its own.

        :param observations: a batch
        :param features: of the critic's encoder, ``(batch, features_dim)``
        :param rows: of the observations, where ``features`` holds some of them several times
        :return: ``(batch, features_dim)``
        """
        if self.policy.share_features_extractor:
            return features.detach()
        own = self.actor.encode(observations)
        return own if rows is None else own[rows]

    def _values_of_policy(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        The critics' values of the policy's own actions, for the actor's loss: their gradient goes to the actions alone.

        :param features: of the critic's encoder, ``(batch, features_dim)``
        :param actions: ``(batch, action_dim)`` in [-1, 1]
        :return: ``(n_critics, batch)``
        """
        held = [parameter for parameter in self.critic_parameters if parameter.requires_grad]  # what a user froze stays so
        for parameter in held:  # or their gradients would be computed and thrown away
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

    def _excluded_save_params(self) -> list[str]:
        critics = [name + suffix for name in ("critic", "critic_target") for suffix in ("", "_parameters")]
        return [*super()._excluded_save_params(), *critics, "batch_norm_stats", "batch_norm_stats_target"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor.optimizer", "critic.optimizer"], []
