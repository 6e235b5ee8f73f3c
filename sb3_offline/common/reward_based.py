"""What algorithms share that learn from rewards."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs

from sb3_offline.common.actor_critic import ActorCriticAlgorithm
from sb3_offline.data.buffer import OfflineReplayBuffer, OfflineSamples
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import DatasetSource

#: Rewards ``(batch,)`` of a batch of transitions; or ``"success"``, the success labels of the dataset.
RewardFunction = Callable[[OfflineSamples], Any] | str


class RewardBasedAlgorithm(ActorCriticAlgorithm):
    """
    The base for algorithms that learn from rewards: the dataset's, or others that take their place.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param dataset: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param reward_fn: a function or model that gives the rewards ``(batch,)`` of a batch of transitions, in place of the
        dataset's. It is called once for each transition, when the dataset is opened, with an
        :class:`~sb3_offline.data.buffer.OfflineSamples` (``observations``, ``actions`` scaled to [-1, 1],
        ``next_observations``, ``dones``, ``rewards`` of the dataset, as tensors on the model's device), and is saved with
        the model. ``"success"`` takes the dataset's success labels, 0 or 1, for rewards.
    :param kwargs: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    """

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetSource | None = None,
        reward_fn: RewardFunction | None = None,
        **kwargs: Any,
    ):
        super().__init__(policy, env, dataset, **kwargs)
        if isinstance(reward_fn, str) and reward_fn != "success":
            raise TypeError(f"{type(self).__name__}: reward_fn is {reward_fn!r}; give a function, or 'success'")
        self.reward_fn = reward_fn

    def _data_sources(self) -> tuple[Any, ...]:
        return (*super()._data_sources(), self.reward_fn)

    def _prepare_data(self) -> None:
        super()._prepare_data()
        self.relabel(self.replay_buffer)
        normalize = self._vec_normalize_env
        if normalize is not None and normalize.norm_reward and normalize.training:
            # Without a rollout, the scale of a VecNormalize has to come from the dataset.
            normalize.ret_rms.var = np.array(self.replay_buffer.return_variance(normalize.gamma))

    def relabel(self, buffer: OfflineReplayBuffer) -> None:
        """
        Put the rewards that this algorithm learns from in place of a dataset's.

        :param buffer: over the model's own dataset, or over another one, to judge the model by
        """
        if callable(self.reward_fn):
            buffer.relabel(self.reward_fn)
        elif self.reward_fn is not None:
            buffer.rewards = buffer.success_rewards()
        elif not buffer.has_rewards:
            remedy = "Record rewards, or say what they are: reward_fn=..."
            raise DatasetError(buffer.datasets[0].path, "rewards", "is missing", remedy)

    def _returns(self, batch: OfflineSamples) -> tuple[th.Tensor, th.Tensor, PyTorchObs]:
        """
        What a target is made of: ``rewards + discounts * value(observations)``.

        :param batch: transitions
        :return: rewards of ``n_steps`` steps, discounted, ``(batch,)``; discounts, 0 where the episode terminated,
            ``(batch,)``; and observations after these steps, shifted as in training
        """
        if self.n_steps == 1:
            rewards, dones, discounts = batch.rewards, batch.dones, batch.discounts
            observations = batch.next_observations
        else:
            rewards, dones, discounts = batch.nstep_rewards, batch.nstep_dones, batch.nstep_discounts  # type: ignore
            observations = batch.nstep_observations  # type: ignore[assignment]
        return rewards.squeeze(1), (discounts * (1 - dones)).squeeze(1), self.augment(observations)
