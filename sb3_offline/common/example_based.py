"""The base of the algorithms that learn from examples of success instead of rewards."""

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs

from sb3_offline.common.actor_critic import ActorCriticAlgorithm
from sb3_offline.common.hyperparameters import COUNT, Constraints
from sb3_offline.common.normalization import normalize_parts
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import ExamplesLike, example_columns, load_examples
from sb3_offline.data.reader import DatasetLike
from sb3_offline.data.spaces import subspace
from sb3_offline.data.stacking import frame_space, repeated_frames

__all__ = ["ExampleBasedAlgorithm", "ExamplesLike"]


class ExampleBasedAlgorithm(ActorCriticAlgorithm):
    """
    The base for algorithms that learn a task from an unlabelled dataset and observations of the completed task, S*.

    The examples of dict observations may lack keys: photographs of success beside a dataset of images and joint angles. What
    is learned of success then sees the keys of the examples only, and the policy sees all keys.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param dataset: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param examples: success examples: a folder of images, an ``.npz`` or HDF5 file, or an array ``(n, *observation)``
        (for dict observations a dict of arrays or paths, of all keys or of some, or one folder of images for the only key of
        images). Arrays are not saved with the model; give them again to ``load``.
    :param example_batch_size: examples in a batch
    :param example_keys: keys of dict observations by which success is known (default: those that the examples hold)
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
        example_keys: Sequence[str] | None = None,
        **kwargs: Any,
    ):
        # Plain attributes for the same reason as `dataset`: `load(path, examples=...)` replaces them.
        self.examples = examples
        self.example_batch_size = example_batch_size
        self.example_keys = example_keys
        self._read_examples: tuple[Any, Any] = (None, None)  # the examples that were read, and what was read
        self._batch_arrays: tuple[tuple[Any, ...], dict[str, np.ndarray]] = ((), {})  # in the form of batches, and of what
        super().__init__(policy, env, dataset, **kwargs)

    def _setup_model(self) -> None:
        if hasattr(self, "observation_space"):
            self.example_keys = self._find_example_keys()
        super()._setup_model()

    def _find_example_keys(self) -> list[str] | None:
        """:return: the keys by which success is known, in the order of the space; ``None`` without a Dict space"""
        space, given = self.observation_space, self.example_keys
        if not isinstance(space, spaces.Dict):
            if given is not None:
                problem = f"example_keys is {given!r}, but observations have no keys: {space}"
                raise TypeError(f"{type(self).__name__}: {problem}; leave it out")
            return None
        if given is not None:
            given = [given] if isinstance(given, str) else list(given)
            if not given or not set(given) <= space.spaces.keys():
                problem = f"example_keys is {given}; give some of the keys of observations"
                raise TypeError(f"{type(self).__name__}: {problem}, {list(space.spaces)}")
        elif self.examples is not None:
            try:
                found = self.load_examples(self.examples)  # of the keys that they hold
                given = list(found) if isinstance(found, dict) else None
                self._read_examples = self.examples, found
            except DatasetError:  # is raised again when the model learns: until then, it needs no examples
                pass
        return [key for key in space.spaces if given is None or key in given]

    @property
    def examples_lack_keys(self) -> bool:
        """``True`` if success is known by some keys of dict observations only."""
        return self.example_keys is not None and len(self.example_keys) < len(self.observation_space.spaces)  # type: ignore

    @property
    def example_space(self) -> spaces.Space:
        """The space of success examples: the observation space, or the keys of it that examples have."""
        return subspace(self.observation_space, self.example_keys) if self.example_keys else self.observation_space

    def seen_in_examples(self, observations: PyTorchObs) -> PyTorchObs:
        """
        :param observations: a batch, as the buffer gives it
        :return: what examples show of it: the batch without the keys that examples lack
        """
        if not self.examples_lack_keys:
            return observations
        return {key: observations[key] for key in self.example_keys}  # type: ignore

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

    def load_examples(self, examples: ExamplesLike) -> np.ndarray | dict[str, np.ndarray]:
        """
        Read success examples, the model's own or others, as observations of :attr:`example_space`.

        Where observations are stacks of frames, an example is one frame, repeated as in a solved scene that rests.
        Arrays of whole stacks are taken as they are.

        :param examples: in any form that learners take
        :return: ``(n, *shape)``, or a dict of such arrays; raises ``DatasetError`` if they do not fit
        """
        frames = frame_space(self.observation_space, self.n_stack)
        try:
            return repeated_frames(load_examples(examples, frames, self.example_keys), frames, self.n_stack)
        except DatasetError:
            if self.n_stack > 1:
                try:
                    return load_examples(examples, self.observation_space, self.example_keys)
                except DatasetError:  # what is wrong with them as frames says more
                    pass
            raise

    def read_examples(self) -> np.ndarray | dict[str, np.ndarray]:
        """
        :return: all success examples as observations of :attr:`example_space`, read once; raises ``RuntimeError`` if the model
            has none
        """
        if self.examples is None:
            raise RuntimeError(
                f"{type(self).__name__} has no success examples to learn from: pass `examples=` to the constructor, "
                "or `load(path, examples=...)`"
            )
        if self._read_examples[0] is not self.examples:
            self._read_examples = self.examples, self.load_examples(self.examples)
        return self._read_examples[1]

    def _example_arrays(self) -> dict[str, np.ndarray]:
        """:return: the examples by key ("" without a dict), normalised and in the layout of batches"""
        normalizer = self._vec_normalize_env
        # A VecNormalize is fitted when the data are opened
        made_of = self.examples, normalizer, None if normalizer is None else self._data.open()
        if [*map(id, made_of)] != [*map(id, self._batch_arrays[0])]:
            examples: Any = self.read_examples()
            if normalizer is not None:
                examples = normalize_parts(normalizer, examples)
            self._batch_arrays = made_of, example_columns(examples)
        return self._batch_arrays[1]

    def _examples_at(self, rows: np.ndarray | slice) -> PyTorchObs:
        batch = {key: th.as_tensor(array[rows], device=self.device) for key, array in self._example_arrays().items()}
        return batch if isinstance(self.observation_space, spaces.Dict) else batch[""]

    def _excluded_save_params(self) -> list[str]:
        excluded = [*super()._excluded_save_params(), "_read_examples", "_batch_arrays"]
        parts = self.examples.values() if isinstance(self.examples, Mapping) else [self.examples]
        only_paths = all(isinstance(part, (str, PathLike)) for part in parts)
        return excluded if only_paths else [*excluded, "examples"]
