"""A pool of weighted transitions, from which batches are drawn by weight."""

from typing import Any

import numpy as np
import torch as th

from sb3_offline.common.losses import effective_share


class WeightedTransitions:
    """
    The transitions of the last batches, drawn again in proportion to their weights.

    A weighted loss over a uniform batch learns from the few transitions that have weight: about one in fifteen if the data
    hold five tasks, each solved now and then. If transitions are drawn by weight, all of a batch count alike, and the expected
    loss is the same.

    :param n_batches: number of kept batches. A weight is at most that many gradient steps old
    """

    _holds_values_only = True  # so that a saved model opens without consent to run code

    def __init__(self, n_batches: int):
        if n_batches < 1:
            raise ValueError(f"The policy has to learn from one batch at least, not from policy_batches={n_batches}")
        self.n_batches = n_batches
        self._n_added = 0
        # Rings of batches, allocated when the batch size is known
        self._indices = th.empty(0, 0, dtype=th.int64)
        self._weights = th.empty(0, 0)

    @property
    def indices(self) -> th.Tensor:
        """(kept batches, batch) int64, indices of the transitions in the dataset; the batches are in no particular order"""
        return self._indices[: self._n_added]

    @property
    def weights(self) -> th.Tensor:
        """(kept batches, batch), the transitions' weights"""
        return self._weights[: self._n_added]

    def add(self, indices: th.Tensor, weights: th.Tensor) -> None:
        """
        Keep a batch in place of the oldest one. A batch of another size than before empties the pool first.

        :param indices: (batch,) int64 on the CPU, indices of the transitions in the dataset
        :param weights: ``(batch,)``, positive, no gradient
        """
        if len(indices) != self._indices.shape[1]:
            self._n_added = 0
            self._indices = indices.new_zeros(self.n_batches, len(indices))
            self._weights = weights.new_zeros(self.n_batches, len(indices))
        self._weights = self._weights.to(weights.device)  # a loaded model has them on the CPU
        row = self._n_added % self.n_batches
        self._indices[row], self._weights[row] = indices, weights
        self._n_added += 1

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_weights": self._weights.cpu()}  # a saved model also loads where its device is missing

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({"_indices" if name == "_steps" else name: value for name, value in state.items()})  # older zips

    def draw(self, n: int) -> np.ndarray:
        """
        :param n: number of transitions
        :return: (n,) indices of transitions, drawn with replacement
        """
        drawn = th.multinomial(self.weights.flatten(), n, replacement=True)
        return self.indices.flatten()[drawn.cpu()].numpy()

    def effective_share(self) -> th.Tensor:
        """:return: scalar, the share of the transitions that would carry as much if all weights were equal"""
        return effective_share(self.weights.flatten())
