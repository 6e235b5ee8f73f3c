"""Policies with a deterministic actor and a target actor."""

import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.td3.policies import Actor

from sb3_offline.common.fast import mlp
from sb3_offline.common.policies import EncodingActor, OfflinePolicy
from sb3_offline.common.torch_layers import NormalizedNatureCNN, StandardizedCombinedExtractor


class DeterministicActor(EncodingActor, Actor):
    """
    SB3's TD3 actor, whose encoder may be the critic's.

    :param args: see :class:`stable_baselines3.td3.policies.Actor`
    :param kwargs: see :class:`~sb3_offline.common.policies.EncodingActor` and :class:`stable_baselines3.td3.policies.Actor`
    """

    def act(self, features: th.Tensor) -> th.Tensor:
        """
        :param features: ``(batch, features_dim)``
        :return: actions in [-1, 1], ``(batch, action_dim)``
        """
        *layers, squash = self.mu
        return squash(mlp(layers, features))

    def forward(self, obs: th.Tensor, deterministic: bool = True) -> th.Tensor:
        return super().forward(obs)  # A policy that acts computes in float32, whatever it learned in.


class TD3BCPolicy(OfflinePolicy):
    """
    Policy class of TD3+BC.

    :param kwargs: see :class:`~sb3_offline.common.policies.OfflinePolicy`; ``std_min`` has no effect
    """

    actor: DeterministicActor  # type: ignore[assignment]
    actor_target: DeterministicActor

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        shared = self.critic_target.features_extractor if self.share_features_extractor else None
        self.actor_target = self.make_actor(shared)
        self.actor_target.load_state_dict(self.actor.state_dict())
        self.actor_target.requires_grad_(False)
        self.actor_target.set_training_mode(False)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> DeterministicActor:  # type: ignore
        actor_kwargs = self._update_features_extractor(self.net_args, features_extractor)
        actor = DeterministicActor(**actor_kwargs, detach_encoder=self.share_features_extractor)
        actor.mixed_precision = self.mixed_precision
        return actor.to(self.device)


MlpPolicy = TD3BCPolicy


class CnnPolicy(TD3BCPolicy):
    """:class:`TD3BCPolicy` for images."""

    default_features_extractor_class = NormalizedNatureCNN


class MultiInputPolicy(TD3BCPolicy):
    """:class:`TD3BCPolicy` for dict observations."""

    default_features_extractor_class = StandardizedCombinedExtractor
