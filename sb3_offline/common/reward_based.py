"""What algorithms share that learn from rewards."""

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_offline.common.actor_critic import ActorCriticAlgorithm
from sb3_offline.data.buffer import OfflineSamples


class RewardBasedAlgorithm(ActorCriticAlgorithm):
    """The base for algorithms that learn from the rewards of the dataset."""

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
