"""ORIL's reward model: a classifier whose probability of success is the reward."""

from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_offline.labelling.classifier import StateClassifier


class RewardClassifier(StateClassifier):
    """
    A :class:`~sb3_offline.labelling.classifier.StateClassifier` that remembers whether it is trained, and always computes in
    float32.

    :param args: see :class:`~sb3_offline.labelling.classifier.StateClassifier`
    :param kwargs: see :class:`~sb3_offline.labelling.classifier.StateClassifier`
    """

    trained: th.Tensor

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.register_buffer("trained", th.zeros(()))  # 1 once it is

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        assert self.features_extractor is not None
        return self.head(self.extract_features(observations, self.features_extractor)).squeeze(1)
