"""Distances between observations and goals."""

from collections.abc import Callable
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_offline.common.choices import counted_from_zero
from sb3_offline.common.torch_layers import StandardizedExtractor


class ObservationVectors:
    """
    Observations as vectors. Images are scaled to [0, 1], vectors are standardised by the dataset's mean and standard
    deviation, and discrete observations are one-hot. The entries of a dict are concatenated.

    :param space: Observation space, images channel-first. Of dict observations, only the keys of this space count
    :param statistics: function that returns (mean, variance, count) of the dataset's observations, or a dict of these for the
        given keys of dict observations; ``None`` if observations are normalised already
    """

    def __init__(self, space: spaces.Space, statistics: Callable[[list[str] | None], Any] | None):
        self.space = space
        parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
        self.scales = {
            key: StandardizedExtractor(part)
            for key, part in parts.items()
            if statistics and isinstance(part, spaces.Box) and not is_image_space(part, check_channels=False)
        }
        if statistics and self.scales:
            moments = statistics([key for key in self.scales if key] or None)
            for key, scale in self.scales.items():
                mean, variance, _ = moments[key] if key else moments
                scale.fit(mean, variance)

    def __call__(self, observations: PyTorchObs) -> th.Tensor:
        """
        :param observations: a batch as the buffer gives it
        :return: ``(batch, n_entries)``
        """
        processed = preprocess_obs(counted_from_zero(observations, self.space), self.space)  # type: ignore[arg-type]
        parts = processed if isinstance(processed, dict) else {"": processed}
        vectors = [self.scales[key].to(x.device)(x) if key in self.scales else x.flatten(1) for key, x in parts.items()]
        return th.cat(vectors, dim=1)


def mean_distance(vectors: th.Tensor, goals: th.Tensor, distance: str) -> th.Tensor:
    """
    :param vectors: ``(batch, n_entries)``
    :param goals: ``(n_goals, n_entries)``
    :param distance: ``"l2"`` for the Euclidean norm of the difference, ``"mse"`` for the mean of its squares
    :return: mean over the goals, ``(batch,)``
    """
    distances = th.cdist(vectors, goals)
    return (distances if distance == "l2" else distances.pow(2) / vectors.shape[1]).mean(dim=1)
