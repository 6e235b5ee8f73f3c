"""Encoders of observations."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor, NatureCNN
from torch import nn

from sb3_offline.common.fast import convolutions, mlp, prepare_convolutions


class StandardizedExtractor(FlattenExtractor):
    """
    Flatten vectors and standardise them, so that each entry has mean 0 and standard deviation 1 over the dataset.

    The statistics are fitted once, by :meth:`fit`, and saved with the policy. Before that, vectors are only flattened.

    Entries that hardly change in the dataset are amplified by at most ``1 / std_min``. Such entries are often constant within
    an episode, and would let a classifier recognise episodes instead of success.

    :param observation_space: space of vectors
    :param std_min: floor of the standard deviation
    """

    mean: th.Tensor
    std: th.Tensor
    fitted: th.Tensor

    def __init__(self, observation_space: spaces.Space, std_min: float = 0.05):
        super().__init__(observation_space)
        self.std_min = std_min
        self.register_buffer("mean", th.zeros(self.features_dim))
        self.register_buffer("std", th.ones(self.features_dim))
        self.register_buffer("fitted", th.zeros(()))  # 1 after `fit`; a float, as all parameters in SB3

    def fit(self, mean: np.ndarray, variance: np.ndarray) -> None:
        """
        :param mean: mean of the dataset's observations, in the shape of one observation
        :param variance: variance of the dataset's observations, in the same shape
        """
        self.mean.copy_(th.as_tensor(mean, dtype=th.float32).flatten())
        self.std.copy_(th.as_tensor(np.sqrt(variance), dtype=th.float32).flatten().clamp(min=self.std_min))
        self.fitted.fill_(1.0)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return (self.flatten(observations) - self.mean) / self.std


class NormalizedNatureCNN(NatureCNN):
    """
    SB3's :class:`~stable_baselines3.common.torch_layers.NatureCNN` with a LayerNorm and a tanh in place of the last ReLU.

    Bounded features bound the logits of a classifier on top of them. With plain ReLU features, a classifier that is trained
    on its own predictions drifts more easily.

    The encoder takes images in [0, 1], as SB3's preprocessing returns them, or uint8 images, which it scales itself.

    :param observation_space: space of uint8 images, channel-first
    :param features_dim: number of features, each in [-1, 1]
    :param normalized_image: see :class:`~stable_baselines3.common.torch_layers.NatureCNN`
    """

    def __init__(self, observation_space: spaces.Box, features_dim: int = 512, normalized_image: bool = False):
        super().__init__(observation_space, features_dim, normalized_image)
        self.linear = nn.Sequential(self.linear[0], nn.LayerNorm(features_dim), nn.Tanh())
        prepare_convolutions(self.cnn)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        if th.jit.is_scripting():  # TorchScript compiles PyTorch's own modules only.
            images = observations / 255.0 if observations.dtype == th.uint8 else observations
            return self.linear(self.cnn(images))
        return mlp(self.linear, convolutions(self.cnn, observations))


class StandardizedCombinedExtractor(CombinedExtractor):
    """
    SB3's :class:`~stable_baselines3.common.torch_layers.CombinedExtractor` with the encoders of this module:
    :class:`NormalizedNatureCNN` for images and :class:`StandardizedExtractor` for vectors.

    :param observation_space: dict space of images (channel-first) and vectors
    :param cnn_output_dim: number of features of each image
    :param normalized_image: see :class:`~stable_baselines3.common.torch_layers.NatureCNN`
    """

    def __init__(self, observation_space: spaces.Dict, cnn_output_dim: int = 256, normalized_image: bool = False):
        super().__init__(observation_space, cnn_output_dim, normalized_image)
        for key, space in observation_space.spaces.items():
            encoder: BaseFeaturesExtractor
            if is_image_space(space, normalized_image=normalized_image):
                encoder = NormalizedNatureCNN(space, cnn_output_dim, normalized_image)  # type: ignore[arg-type]
            elif isinstance(space, spaces.Box):
                encoder = StandardizedExtractor(space)
            else:
                continue  # One-hot vectors are not standardised.
            self.extractors[key] = encoder


def standardized_encoders(network: nn.Module) -> dict[StandardizedExtractor, str]:
    """
    :param network: a network with encoders in it
    :return: its encoders of vectors, with their keys in dict observations. One-hot vectors and flattened images are not
        standardised.
    """
    encoders = {
        module: ""
        for module in network.modules()
        if isinstance(module, StandardizedExtractor)
        and isinstance(module._observation_space, spaces.Box)
        and not is_image_space(module._observation_space, check_channels=False)
    }
    for module in network.modules():
        if isinstance(module, StandardizedCombinedExtractor):
            encoders.update({part: key for key, part in module.extractors.items() if part in encoders})
    return encoders


def fit_statistics(network: nn.Module, statistics: Callable[[list[str] | None], Any]) -> None:
    """
    Fit every :class:`StandardizedExtractor` of a network that is not fitted yet.

    :param network: a network with encoders in it
    :param statistics: function that returns (mean, variance, count) of the dataset's observations, or a dict of such
        triples for the given keys of dict observations. It is called only if there is something to fit.
    """
    unfitted = {encoder: key for encoder, key in standardized_encoders(network).items() if not encoder.fitted}
    if unfitted:
        moments = statistics([key for key in unfitted.values() if key] or None)
        for encoder, key in unfitted.items():
            mean, variance, _ = moments[key] if key else moments
            encoder.fit(np.asarray(mean), np.asarray(variance))
