"""Replay buffers that mix the steps of a dataset with those of an environment."""

from typing import Any

import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_offline.data.buffer import OfflineReplayBuffer, joined
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import DatasetLike


class _Mixed:
    def __init__(
        self,
        *args: Any,
        dataset: DatasetLike,
        data_ratio: float = 0.5,
        n_stack: int = 1,
        rewards: np.ndarray | None = None,
        checksum: int | None = None,
        **kwargs: Any,
    ):
        super().__init__(*args, **kwargs)
        if not 0 <= data_ratio <= 1:
            raise DatasetError("", "data_ratio", f"is {data_ratio}", "Give the share of a batch that the dataset has, 0 to 1")
        self.data_ratio = data_ratio
        seed = np.random.randint(2**31)  # SB3 seeds NumPy's generator, which its own buffers draw from
        learner = self.observation_space, self.action_space, self.device  # type: ignore[attr-defined]
        self.offline = OfflineReplayBuffer(dataset, *learner, n_stack=n_stack, seed=seed)
        if rewards is not None:
            if len(rewards) != self.offline.size() or checksum not in (None, self.offline.checksum()):
                problem = f"are of other data: {len(rewards)} rewards, and the dataset has {self.offline.size()} steps"
                remedy = "Give the dataset that they were made for, or export the model again"
                raise DatasetError(self.offline.datasets[0].path, "rewards", problem, remedy)
            self.offline.rewards = rewards
        if not self.offline.has_rewards:
            problem, remedy = "are missing, but a learner from rewards asks for them", "Give a dataset with rewards"
            raise DatasetError(self.offline.datasets[0].path, "rewards", problem, remedy)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        :param batch_size: number of transitions
        :param env: normalises observations and rewards
        :return: ``round(data_ratio * batch_size)`` transitions of the dataset (all, while there are no others), then those of
            the environment
        """
        n_data = round(self.data_ratio * batch_size) if self.size() else batch_size  # type: ignore[attr-defined]
        parts = [self.offline.sample(n_data, env)[:5]] if n_data else []
        if n_data < batch_size:
            parts.append(super().sample(batch_size - n_data, env)[:5])  # type: ignore[misc]
        return ReplayBufferSamples(*(joined(fields) for fields in zip(*parts, strict=True)))  # type: ignore[arg-type]


class MixedReplayBuffer(_Mixed, ReplayBuffer):
    """
    A ``ReplayBuffer`` whose batches mix transitions of a dataset, in a given ratio, with those that were added to it::

        SAC("MlpPolicy", env, replay_buffer_class=MixedReplayBuffer,
            replay_buffer_kwargs={"dataset": "data.h5", "data_ratio": 0.5})

    :param args: see :class:`stable_baselines3.common.buffers.ReplayBuffer`
    :param dataset: path, glob pattern, ``OfflineDataset``, or a sequence of these. It needs rewards unless ``rewards`` is
        given
    :param data_ratio: share of each batch that comes from the dataset
    :param n_stack: number of frames that the environment's ``VecFrameStack`` stacks
    :param rewards: (steps,) float32, rewards that replace the dataset's
    :param checksum: checksum of the data that ``rewards`` belong to (:meth:`OfflineReplayBuffer.checksum
        <sb3_offline.data.buffer.OfflineReplayBuffer.checksum>`); other data raise ``DatasetError``
    :param kwargs: see :class:`stable_baselines3.common.buffers.ReplayBuffer`
    """


class MixedDictReplayBuffer(_Mixed, DictReplayBuffer):  # type: ignore[misc]
    """:class:`MixedReplayBuffer` for dict observations."""
