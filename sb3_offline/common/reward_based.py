"""The base of the algorithms that learn from rewards."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs

from sb3_offline.common.actor_critic import ActorCriticAlgorithm
from sb3_offline.data.buffer import OfflineReplayBuffer, OfflineSamples
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import DatasetLike


@runtime_checkable
class DataRewards(Protocol):
    """Rewards that belong to certain data, such as the labels of :func:`sb3_offline.label_episodes`."""

    def rewards_of(self, buffer: OfflineReplayBuffer) -> np.ndarray:
        """
        :param buffer: the data that a model learns from; raises ``DatasetError`` if the rewards belong to others
        :return: (N,) float32
        """
        ...


#: Rewards ``(batch,)`` of a batch of transitions; labels of the data; or ``"success"``, the success labels of the dataset.
RewardFunction = Callable[[OfflineSamples], Any] | DataRewards | str


class RewardBasedAlgorithm(ActorCriticAlgorithm):
    """
    The base for algorithms that learn from rewards: the dataset's, or others in their place.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param dataset: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param reward_fn: a function or model that returns the rewards ``(batch,)`` of a batch of transitions, in place of the
        dataset's. It is called once for each transition, when the dataset is opened, and is saved with the model. Its
        argument is an :class:`~sb3_offline.data.buffer.OfflineSamples` (``observations``, ``actions`` scaled to [-1, 1],
        ``next_observations``, ``dones``, ``rewards`` of the dataset, as tensors on the model's device). ``"success"`` takes
        the dataset's success labels, 0 or 1, as rewards, and the labels of :func:`~sb3_offline.label_episodes` stand for
        themselves: ``reward_fn=label_episodes(dataset, examples)``.
    :param kwargs: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    """

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        reward_fn: RewardFunction | None = None,
        **kwargs: Any,
    ):
        super().__init__(policy, env, dataset, **kwargs)
        if isinstance(reward_fn, str) and reward_fn != "success":
            remedy = "give a function, 'success', or the labels that are made from examples: label_episodes(dataset, examples)"
            raise TypeError(f"{type(self).__name__}: reward_fn is {reward_fn!r}; {remedy}")
        self.reward_fn = reward_fn

    def _data_inputs(self) -> tuple[Any, ...]:
        return (*super()._data_inputs(), self.reward_fn)

    def _on_data_opened(self, buffer: OfflineReplayBuffer) -> None:
        super()._on_data_opened(buffer)
        normalizer = self._vec_normalize_env
        if normalizer is not None and normalizer.norm_reward and normalizer.training:
            # No rollout fits the scale of a VecNormalize here, so it comes from the dataset
            normalizer.ret_rms.var = np.array(buffer.return_variance(normalizer.gamma))

    def relabel(self, buffer: OfflineReplayBuffer) -> None:
        if isinstance(self.reward_fn, DataRewards):
            buffer.rewards = self.reward_fn.rewards_of(buffer)
        elif callable(self.reward_fn):
            buffer.relabel(self.reward_fn)
        elif self.reward_fn is not None:
            buffer.rewards = buffer.success_rewards()
        elif not buffer.has_rewards:
            remedy = "Record rewards, or say what they are: reward_fn=..."
            raise DatasetError(buffer.datasets[0].path, "rewards", "is missing", remedy)

    def _returns(self, batch: OfflineSamples) -> tuple[th.Tensor, th.Tensor, PyTorchObs]:
        """
        The parts of a target ``rewards + discounts * value(observations)`` over the longest horizon.

        :param batch: transitions
        :return: discounted sums of ``n_steps`` rewards, ``(batch,)``; discounts, 0 where the episode terminated,
            ``(batch,)``; and the observations after these steps, shifted as in training
        """
        horizon = batch.horizons[-1]
        discounts = horizon.discounts * (1 - horizon.dones)
        return horizon.rewards.squeeze(1), discounts.squeeze(1), self.augment(horizon.observations)
