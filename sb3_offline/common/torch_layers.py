"""Encoders for images."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import NatureCNN
from torch import nn


class NormalizedNatureCNN(NatureCNN):
    """
    SB3's :class:`~stable_baselines3.common.torch_layers.NatureCNN` with a LayerNorm and a tanh in place of the last ReLU.

    Bounded features keep the logits of a classifier on top of them bounded too; with plain ReLU features a classifier that
    is trained on its own predictions drifts more easily.

    :param observation_space: uint8 images, channel-first
    :param features_dim: number of features, each in [-1, 1]
    :param normalized_image: see :class:`~stable_baselines3.common.torch_layers.NatureCNN`
    """

    def __init__(self, observation_space: spaces.Box, features_dim: int = 512, normalized_image: bool = False):
        super().__init__(observation_space, features_dim, normalized_image)
        self.linear = nn.Sequential(self.linear[0], nn.LayerNorm(features_dim), nn.Tanh())

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.linear(self.cnn(observations))
