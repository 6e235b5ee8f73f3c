"""Observations of Discrete and MultiDiscrete spaces, counted from 0."""

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs


def counted_from_zero(observations: PyTorchObs, space: spaces.Space) -> PyTorchObs:
    """
    Count the choices of Discrete and MultiDiscrete spaces from 0. SB3's one-hot encoding ignores ``start``.

    :param observations: a batch of observations of the space, or a dict of such. Keys that the space lacks are left out, so a
        network that sees some keys only takes whole observations
    :param space: Observation space
    :return: the observations less ``start``; observations of other spaces stay as they are
    """
    if isinstance(observations, dict):
        assert isinstance(space, spaces.Dict)
        return {key: _shifted(part, space[key]) for key, part in observations.items() if key in space.spaces}
    return _shifted(observations, space)


def _shifted(observations: th.Tensor, space: spaces.Space) -> th.Tensor:
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete) and np.any(space.start):
        return observations - th.as_tensor(space.start, device=observations.device)
    return observations


class CountingFromZero(BaseModel):
    """Base class of networks whose Discrete and MultiDiscrete observations may count from another number than 0."""

    def extract_features(self, obs: PyTorchObs, features_extractor: BaseFeaturesExtractor) -> th.Tensor:
        """
        :param obs: a batch of observations
        :param features_extractor: encoder of the observations
        :return: features, ``(batch, features_dim)``
        """
        return super().extract_features(counted_from_zero(obs, self.observation_space), features_extractor)
