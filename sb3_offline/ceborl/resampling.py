"""Batches in which no transition is drawn in vain."""

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
        self.n_batches = n_batches
        self.steps: list[th.Tensor] = []
        self.weights: list[th.Tensor] = []

    def add(self, steps: th.Tensor, weights: th.Tensor) -> None:
        """
        :param steps: (batch,) int64 on the CPU, numbers of the transitions in the dataset
        :param weights: ``(batch,)``, positive, no gradient
        """
        self.steps = [*self.steps, steps][-self.n_batches :]
        self.weights = [*self.weights, weights][-self.n_batches :]

    def draw(self, n: int) -> np.ndarray:
        """
        :param n: how many
        :return: (n,) numbers of transitions, with replacement
        """
        drawn = th.multinomial(th.cat(self.weights), n, replacement=True)
        return th.cat(self.steps)[drawn.cpu()].numpy()

    def effective_share(self) -> th.Tensor:
        """:return: scalar, the part of the transitions that would carry as much if all had the same weight"""
        return effective_share(th.cat(self.weights))
