"""Weighted transitions, from which batches are drawn by weight."""

from typing import Any

import numpy as np
import torch as th

from sb3_offline.common.losses import effective_share

#: Transitions for which the running sum of the weights is computed anew at each draw; of more, it is as many draws old
SUMMED_AT_ONCE = 500_000


class WeightedTransitions:
    """
    A weight for each transition of a dataset, by which transitions are drawn.

    A weighted loss over a uniform batch learns from the few transitions that have weight: about one in fifteen if the data
    hold five tasks, each solved now and then. If transitions are drawn by weight, all of a batch count alike, and the expected
    loss is the same.

    :param n_transitions: number of transitions N of the dataset. None is drawn before it has a weight
    """

    _holds_values_only = True  # so that a saved model opens without consent to run code

    def __init__(self, n_transitions: int):
        #: (N,) float32, the last weight of each transition, 0 before the first one
        self.weights = th.zeros(n_transitions)
        self._sums = th.zeros(0, dtype=th.float64)
        self._draws_left = 0

    def add(self, indices: th.Tensor, weights: th.Tensor) -> None:
        """
        :param indices: (batch,) int64 on the CPU, indices of transitions
        :param weights: ``(batch,)``, their new weights, not negative, no gradient
        """
        if self.weights.device != weights.device:
            self.weights = self.weights.to(weights.device)  # a new or loaded model has them on the CPU
        self.weights[indices.to(weights.device)] = weights.float()

    def draw(self, n: int) -> np.ndarray:
        """
        :param n: number of transitions
        :return: (n,) indices of transitions, drawn with replacement
        """
        if self._draws_left == 0:
            self._sums = self.weights.cumsum(0, dtype=th.float64)
            self._draws_left = 1 + len(self.weights) // SUMMED_AT_ONCE
        self._draws_left -= 1
        # Above 0, so that no transition without a weight is drawn
        drawn = (1 - th.rand(n, dtype=th.float64, device=self._sums.device)) * self._sums[-1]
        return th.searchsorted(self._sums, drawn).clamp(max=len(self._sums) - 1).cpu().numpy()

    def effective_share(self) -> th.Tensor:
        """:return: scalar, the share of the weighted transitions that would carry as much if all weights were equal"""
        n_weighted = (self.weights > 0).sum().clamp(min=1)  # a mask would make a GPU wait
        return effective_share(self.weights) * len(self.weights) / n_weighted

    def __getstate__(self) -> dict[str, Any]:
        return {"weights": self.weights.cpu()}  # a saved model also loads where its device is missing

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Models of earlier versions kept their last batches, which weigh no dataset as a whole: those start anew
        self.__init__(0)  # type: ignore[misc]
        self.weights = state.get("weights", self.weights)
