"""Policies without a critic, whose actor trains its own encoder."""

from typing import Any

from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule

from sb3_offline.common.policies import OfflinePolicy
from sb3_offline.common.torch_layers import NormalizedNatureCNN, StandardizedCombinedExtractor


class BCPolicy(OfflinePolicy):
    """
    Policy class of behavioral cloning.

    :param kwargs: see :class:`~sb3_offline.common.policies.OfflinePolicy`; arguments for critics have no effect
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        share_features_extractor: bool = False,
        std_min: float = 0.05,
        **kwargs: Any,
    ):
        if share_features_extractor:
            raise TypeError("BC has no critic to share an encoder with; leave out share_features_extractor")
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            share_features_extractor=share_features_extractor,
            std_min=std_min,
            **kwargs,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        self.actor = self.make_actor()
        self.actor.optimizer = self._make_optimizer(list(self.actor.parameters()), lr_schedule)

    def set_training_mode(self, mode: bool) -> None:
        self.actor.set_training_mode(mode)
        self.training = mode


MlpPolicy = BCPolicy


class CnnPolicy(BCPolicy):
    """:class:`BCPolicy` for images."""

    default_features_extractor_class = NormalizedNatureCNN


class MultiInputPolicy(BCPolicy):
    """:class:`BCPolicy` for dict observations."""

    default_features_extractor_class = StandardizedCombinedExtractor
