"""Batches in which no transition is drawn in vain."""

from typing import Any

import numpy as np
import torch as th

from sb3_offline.common.losses import effective_share


class WeightedTransitions:
    """
    The transitions of the last batches, drawn again in proportion to their weights.

    A weighted loss over a uniform batch learns from the few transitions that have weight: one in fifteen where the data hold
    five tasks, each solved now and then. Drawn by weight, all of a batch count alike, and the expectation is the same.

    :param n_batches: how many batches are kept; weights are as old as the oldest of them at most
    """

    def __init__(self, n_batches: int):
        if n_batches < 1:
            raise ValueError(f"The policy has to learn from one batch at least, not from policy_batches={n_batches}")
        self.n_batches = n_batches
        self._n_added = 0
        # Rings of batches, made when their size is known
        self._steps = th.empty(0, 0, dtype=th.int64)
        self._weights = th.empty(0, 0)

    @property
    def steps(self) -> th.Tensor:
        """(kept batches, batch) int64, numbers of the transitions in the dataset, in no particular order of batches"""
        return self._steps[: self._n_added]

    @property
    def weights(self) -> th.Tensor:
        """(kept batches, batch) of the transitions"""
        return self._weights[: self._n_added]

    def add(self, steps: th.Tensor, weights: th.Tensor) -> None:
        """
        :param steps: (batch,) int64 on the CPU, numbers of the transitions in the dataset; batches of another size than
            before start anew
        :param weights: ``(batch,)``, positive, no gradient
        """
        if len(steps) != self._steps.shape[1]:
            self._n_added = 0
            self._steps = steps.new_zeros(self.n_batches, len(steps))
            self._weights = weights.new_zeros(self.n_batches, len(steps))
        self._weights = self._weights.to(weights.device)  # a model that was loaded has them on the CPU
        row = self._n_added % self.n_batches
        self._steps[row], self._weights[row] = steps, weights
        self._n_added += 1

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_weights": self._weights.cpu()}  # a saved model loads where there is no such device

    def draw(self, n: int) -> np.ndarray:
        """
        :param n: how many
        :return: (n,) numbers of transitions, with replacement
        """
        drawn = th.multinomial(self.weights.flatten(), n, replacement=True)
        return self.steps.flatten()[drawn.cpu()].numpy()

    def effective_share(self) -> th.Tensor:
        """:return: scalar, the part of the transitions that would carry as much if all had the same weight"""
        return effective_share(self.weights.flatten())
