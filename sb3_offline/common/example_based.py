"""The base of the algorithms that learn from examples of success instead of rewards."""

from collections.abc import Mapping
from os import PathLike
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs

from sb3_offline.common.actor_critic import ActorCriticAlgorithm
from sb3_offline.common.hyperparameters import COUNT, Constraints
from sb3_offline.data.examples import load_examples
from sb3_offline.data.reader import DatasetLike

#: Whatever is accepted where success examples are asked for
ExamplesLike = str | PathLike | np.ndarray | dict[str, np.ndarray]


class ExampleBasedAlgorithm(ActorCriticAlgorithm):
    """
    The base for algorithms that learn a task from an unlabelled dataset and observations of the completed task, S*.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param dataset: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param examples: success examples: a folder of images, an ``.npz`` or HDF5 file, or an array ``(n, *observation)``
        (a dict of arrays for dict observations). Arrays are not saved with the model; give them again to ``load``.
    :param example_batch_size: examples in a batch
    :param kwargs: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    """

    _parameter_constraints: ClassVar[Mapping[str, Constraints]] = {"example_batch_size": [COUNT]}

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        examples: ExamplesLike | None = None,
        example_batch_size: int = 256,
        **kwargs: Any,
    ):
        # Plain attributes for the same reason as `dataset`: `load(path, examples=...)` replaces them.
        self.examples = examples
        self.example_batch_size = example_batch_size
        self._read_examples: tuple[Any, Any] = (None, None)  # the examples that were read, and what was read
        self._batch_arrays: tuple[tuple[Any, ...], dict[str, np.ndarray]] = ((), {})  # in the form of batches, and of what
        super().__init__(policy, env, dataset, **kwargs)

    def all_examples(self) -> PyTorchObs:
        """
        :return: all success examples, like a batch of observations
        """
        return self._examples_at(slice(None))

    def sample_examples(self) -> tuple[PyTorchObs, th.Tensor]:
        """
        Draw ``example_batch_size`` success examples with replacement. A batch often holds more than there are examples, so
        each drawn example is returned once, and no image is encoded twice.

        :return: the drawn examples, like a batch of observations, and for each place in the batch its row in them
        """
        n_examples = len(next(iter(self._example_arrays().values())))
        drawn = self.replay_buffer.rng.integers(n_examples, size=self.example_batch_size)
        distinct, rows = np.unique(drawn, return_inverse=True)
        return self._examples_at(distinct), th.as_tensor(rows, device=self.device)

    def read_examples(self) -> np.ndarray | dict[str, np.ndarray]:
        """
        :return: all success examples as observations of the model's space, read once; raises ``RuntimeError`` if the model has
            none
        """
        if self.examples is None:
            raise RuntimeError(
                f"{type(self).__name__} has no success examples to learn from: pass `examples=` to the constructor, "
                "or `load(path, examples=...)`"
            )
        if self._read_examples[0] is not self.examples:
            self._read_examples = self.examples, load_examples(self.examples, self.observation_space)
        return self._read_examples[1]

    def _example_arrays(self) -> dict[str, np.ndarray]:
        """:return: the examples by key ("" without a dict), normalised and in the layout of batches"""
        normalizer = self._vec_normalize_env
        # A VecNormalize is fitted when the data are opened
        made_of = self.examples, normalizer, None if normalizer is None else self._data.open()
        if [*map(id, made_of)] != [*map(id, self._batch_arrays[0])]:
            examples: Any = self.read_examples()
            if normalizer is not None:
                examples = normalizer.normalize_obs(examples)
            arrays = examples if isinstance(examples, dict) else {"": examples}
            # Observations of a discrete space become columns, as in the buffer
            columns = {key: array[:, None] if array.ndim == 1 else array for key, array in arrays.items()}
            self._batch_arrays = made_of, columns
        return self._batch_arrays[1]

    def _examples_at(self, rows: np.ndarray | slice) -> PyTorchObs:
        batch = {key: th.as_tensor(array[rows], device=self.device) for key, array in self._example_arrays().items()}
        return batch if isinstance(self.observation_space, spaces.Dict) else batch[""]

    def _excluded_save_params(self) -> list[str]:
        excluded = [*super()._excluded_save_params(), "_read_examples", "_batch_arrays"]
        return excluded if isinstance(self.examples, (str, PathLike)) else [*excluded, "examples"]
