"""ORIL's reward model: a classifier whose probability of success is the reward."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_offline.common.choices import CountingFromZero


class RewardClassifier(CountingFromZero):
    """
    A classifier that tells success examples from the dataset's observations. It has its own encoder and sees no action.

    :param observation_space: Observation space
    :param action_space: Action space
    :param features_extractor: encoder of the observations
    :param net_arch: hidden layers on top of it
    :param kwargs: see :class:`stable_baselines3.common.policies.BaseModel`
    """

    trained: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        features_extractor: BaseFeaturesExtractor,
        net_arch: list[int],
        **kwargs: Any,
    ):
        super().__init__(observation_space, action_space, features_extractor=features_extractor, **kwargs)
        self.head = nn.Sequential(*create_mlp(features_extractor.features_dim, 1, net_arch))
        self.register_buffer("trained", th.zeros(()))  # 1 once it is

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """
        :param observations: uint8 images channel-first or float vectors (or a dict of them), batch first
        :return: logits, ``(batch,)``
        """
        assert self.features_extractor is not None
        return self.head(self.extract_features(observations, self.features_extractor)).squeeze(1)
