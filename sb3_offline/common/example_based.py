"""What algorithms share that learn from examples of success instead of rewards."""

from os import PathLike
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs

from sb3_offline.common.actor_critic import ActorCriticAlgorithm
from sb3_offline.common.hyperparameters import COUNT
from sb3_offline.data.examples import load_examples
from sb3_offline.data.reader import DatasetSource

ExampleSource = str | PathLike | np.ndarray | dict[str, np.ndarray]


class ExampleBasedAlgorithm(ActorCriticAlgorithm):
    """
    The base for algorithms that are given observations of a completed task, S*, beside the unlabelled dataset.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param dataset: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param examples: success examples: a folder of pictures, an ``.npz`` or HDF5 file, or an array ``(n, *observation)``
        (a dict of arrays for dict observations). Arrays are not saved with the model; give them again to ``load``.
    :param example_batch_size: examples in a batch
    :param kwargs: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    """

    numbers: ClassVar[dict[str, str]] = {"example_batch_size": COUNT}

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetSource | None = None,
        examples: ExampleSource | None = None,
        example_batch_size: int = 256,
        **kwargs: Any,
    ):
        # Plain attributes for the same reason as `dataset`: `load(path, examples=...)` replaces them.
        self.examples = examples
        self.example_batch_size = example_batch_size
        self._example_arrays: dict[str, np.ndarray] | None = None
        self._example_source: ExampleSource | None = None
        super().__init__(policy, env, dataset, **kwargs)

    def all_examples(self) -> PyTorchObs:
        """
        :return: all success examples, like a batch of observations
        """
        return self._examples_at(slice(None))

    def sample_examples(self) -> tuple[PyTorchObs, th.Tensor]:
        """
        ``example_batch_size`` success examples, drawn with replacement. There are often fewer of them than a batch holds, so
        each that was drawn comes once: no image is encoded twice.

        :return: the examples that were drawn, like a batch of observations, and for each place in the batch its row in them
        """
        n_examples = len(next(iter(self._loaded_examples().values())))
        drawn = self.replay_buffer.rng.integers(n_examples, size=self.example_batch_size)
        distinct, rows = np.unique(drawn, return_inverse=True)
        return self._examples_at(distinct), th.as_tensor(rows, device=self.device)

    def _prepare_data(self) -> None:
        self._example_arrays = None  # normalised by the statistics of another dataset, perhaps
        super()._prepare_data()

    def _loaded_examples(self) -> dict[str, np.ndarray]:
        if self._example_arrays is None or self._example_source is not self.examples:
            self._example_arrays, self._example_source = self._load_examples(), self.examples
        return self._example_arrays

    def _examples_at(self, rows: np.ndarray | slice) -> PyTorchObs:
        arrays = self._loaded_examples()
        batch = {key: th.as_tensor(array[rows], device=self.device) for key, array in arrays.items()}
        return batch if isinstance(self.observation_space, spaces.Dict) else batch[""]

    def _load_examples(self) -> dict[str, np.ndarray]:
        if self.examples is None:
            raise RuntimeError(
                f"{type(self).__name__} has no success examples to learn from: pass `examples=` to the constructor, "
                "or `load(path, examples=...)`"
            )
        examples = load_examples(self.examples, self.observation_space)
        if self._vec_normalize_env is not None:
            self.replay_buffer  # noqa: B018  (the statistics are fitted when the dataset is opened)
            examples = self._vec_normalize_env.normalize_obs(examples)
        arrays = examples if isinstance(examples, dict) else {"": examples}
        # Numbers of a discrete space become columns, as the buffer gives them.
        return {key: array[:, None] if array.ndim == 1 else array for key, array in arrays.items()}

    def _excluded_save_params(self) -> list[str]:
        excluded = [*super()._excluded_save_params(), "_example_arrays", "_example_source"]
        return excluded if isinstance(self.examples, (str, PathLike)) else [*excluded, "examples"]
