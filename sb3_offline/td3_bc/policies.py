"""Policies with a deterministic actor and a target of it."""

from typing import Any

import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.td3.policies import Actor

from sb3_offline.common.policies import OfflinePolicy
from sb3_offline.common.torch_layers import NormalizedNatureCNN, StandardizedCombinedExtractor


class DeterministicActor(Actor):
    """
    SB3's actor of TD3, whose encoder may be the critic's.

    :param detach_encoder: whether the encoder belongs to the critic, so that no gradient of the actor reaches it
    :param kwargs: see :class:`stable_baselines3.td3.policies.Actor`
    """

    def __init__(self, *args: Any, detach_encoder: bool = True, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.detach_encoder = detach_encoder

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "detach_encoder": self.detach_encoder}

    def encode(self, obs: PyTorchObs) -> th.Tensor:
        """
        :param obs: observations, uint8 images channel-first or float vectors (or a dict of them), batch first
        :return: features, ``(batch, features_dim)``, cut from the graph where the encoder is the critic's
        """
        with th.set_grad_enabled(th.is_grad_enabled() and not self.detach_encoder):
            return self.extract_features(obs, self.features_extractor)

    def act(self, features: th.Tensor) -> th.Tensor:
        """
        :param features: ``(batch, features_dim)``
        :return: actions in [-1, 1], ``(batch, action_dim)``
        """
        weight = next(self.mu.parameters())
        return self.mu(features.to(weight.dtype))  # the critic's may come in the lower precision that it learns in

    def forward(self, obs: PyTorchObs, deterministic: bool = True) -> th.Tensor:  # type: ignore[override]
        return self.act(self.encode(obs))


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
        return DeterministicActor(**actor_kwargs, detach_encoder=self.share_features_extractor).to(self.device)


MlpPolicy = TD3BCPolicy


class CnnPolicy(TD3BCPolicy):
    """:class:`TD3BCPolicy` for images."""

    default_features_extractor_class = NormalizedNatureCNN


class MultiInputPolicy(TD3BCPolicy):
    """:class:`TD3BCPolicy` for dict observations."""

    default_features_extractor_class = StandardizedCombinedExtractor
