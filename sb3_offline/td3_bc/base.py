"""TD3's update on a fixed dataset, for TD3+BC and its relatives."""

from collections.abc import Mapping
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import polyak_update

from sb3_offline.common.hyperparameters import COUNT, NOT_NEGATIVE, Constraints
from sb3_offline.common.losses import bellman_loss
from sb3_offline.common.reward_based import RewardBasedAlgorithm, RewardFunction
from sb3_offline.data.buffer import OfflineSamples
from sb3_offline.data.reader import DatasetLike
from sb3_offline.td3_bc.policies import CnnPolicy, DeterministicActor, MlpPolicy, MultiInputPolicy, TD3BCPolicy


class OfflineTD3(RewardBasedAlgorithm):
    """
    The base for algorithms that update as TD3 does. The policy is deterministic and is updated less often than the critics.
    It has a target network too, whose actions get noise. A subclass defines the actor's loss (``_actor_loss``), and may change
    the values that the critics' targets are made of (``_target_values``).

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param dataset: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param reward_fn: see :class:`~sb3_offline.common.reward_based.RewardBasedAlgorithm`
    :param policy_delay: gradient steps for each update of the actor and of the target networks
    :param target_policy_noise: standard deviation of the noise on the target's actions
    :param target_noise_clip: bound of that noise
    :param kwargs: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    _parameter_constraints: ClassVar[Mapping[str, Constraints]] = {
        "policy_delay": [COUNT],
        "target_policy_noise": [NOT_NEGATIVE],
        "target_noise_clip": [NOT_NEGATIVE],
    }
    policy: TD3BCPolicy
    actor: DeterministicActor  # type: ignore[assignment]
    actor_target: DeterministicActor

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        reward_fn: RewardFunction | None = None,
        policy_delay: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        **kwargs: Any,
    ):
        super().__init__(policy, env, dataset, reward_fn, **kwargs)
        self.policy_delay = policy_delay
        self.target_policy_noise = target_policy_noise
        self.target_noise_clip = target_noise_clip

    def _setup_model(self) -> None:
        self.target_update_interval = self.policy_delay  # also of a model that is loaded with another one
        super()._setup_model()

    def _create_aliases(self) -> None:
        super()._create_aliases()
        self.actor_target = self.policy.actor_target

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])

        for _ in range(gradient_steps):
            batch = self._sample_batch(batch_size)
            observations = self.augment(batch.observations)
            features = self.critic.encode(observations)
            with th.no_grad():
                rewards, discounts, next_observations = self._returns(batch)
                next_features = self.critic_target.encode(next_observations)
                shared = self.policy.share_features_extractor
                next_actions = self.actor_target.act(next_features if shared else self.actor_target.encode(next_observations))
                next_actions = (next_actions + self._target_noise(next_actions)).clamp(-1, 1)
                next_values = self.critic_target.values(next_features, next_actions).amin(dim=0)
                targets = rewards + discounts * self._target_values(next_values, next_actions, batch)

            values = self.critic.values(features, batch.actions)
            critic_loss = bellman_loss(values, targets)
            self._optimize(self.critic.optimizer, critic_loss)
            self._record(critic_loss=critic_loss, values_data=values.mean())

            self._n_updates += 1
            if self._n_updates % self.policy_delay == 0:
                actions = self.actor.act(self._policy_features(observations, features))
                actor_loss = self._actor_loss(self._values_of_policy(features, actions), actions, batch.actions)
                self._optimize(self.actor.optimizer, actor_loss)
                self._record(actor_loss=actor_loss)
            self._update_target()

    def _sample_batch(self, batch_size: int) -> OfflineSamples:
        """:return: transitions to learn from"""
        return self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)

    def _target_noise(self, actions: th.Tensor) -> th.Tensor:
        """:return: like ``actions``: noise that smooths the target over similar actions"""
        noise = self.target_policy_noise * th.randn_like(actions)
        return noise.clamp(-self.target_noise_clip, self.target_noise_clip)

    def _target_values(self, next_values: th.Tensor, next_actions: th.Tensor, batch: OfflineSamples) -> th.Tensor:
        """
        :param next_values: the smallest of the target critics' values, ``(batch,)``
        :param next_actions: of the target policy, with noise, ``(batch, action_dim)``
        :param batch: the transitions
        :return: the values that the targets are made of, ``(batch,)``
        """
        return next_values

    def _actor_loss(self, values: th.Tensor, actions: th.Tensor, data_actions: th.Tensor) -> th.Tensor:
        """
        :param values: of the policy's actions, ``(n_critics, batch)``
        :param actions: of the policy, ``(batch, action_dim)``
        :param data_actions: of the dataset, ``(batch, action_dim)``
        :return: scalar; its parts are recorded
        """
        raise NotImplementedError

    def _update_target(self) -> None:
        super()._update_target()
        if self._n_updates % self.policy_delay == 0:
            # A shared encoder's target is the critic's, updated already.
            heads = (m if not self.policy.share_features_extractor else m.mu for m in (self.actor, self.actor_target))
            source, target = (head.parameters() for head in heads)
            polyak_update(source, target, self.tau)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "actor_target"]
