"""AWAC: Advantage Weighted Actor-Critic."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_offline.awac.losses import sampled_advantages, softmax_weights
from sb3_offline.common.hyperparameters import COUNT, POSITIVE, Constraints
from sb3_offline.common.losses import bellman_loss, effective_share
from sb3_offline.common.reward_based import RewardBasedAlgorithm, RewardFunction
from sb3_offline.common.search import BOOTSTRAPPING, Choice, SearchSpace, log_uniform
from sb3_offline.data.reader import DatasetLike


class AWAC(RewardBasedAlgorithm):
    """
    Advantage Weighted Actor-Critic (AWAC, https://arxiv.org/abs/2006.09359): the policy imitates the dataset's actions. An
    action weighs more, the further its value lies above that of the policy's own actions::

        y = r + gamma (1 - terminated) min_i Qbar_i(s', a'),    a' ~ pi(s')
        critic:  min  sum_i E_D[(Q_i(s, a) - y)^2]
        actor:   max  E_D[w(s, a) log pi(a | s)],    w(s, a) = exp(A(s, a) / temperature) / E_D[exp(A / temperature)]
                 A(s, a) = min_i Q_i(s, a) - V(s),   V(s) = mean_k min_i Q_i(s, a_k),   a_k ~ pi(s)

    The means E_D are over the batch, so the weights of a batch have the mean 1. The target has no entropy term.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment the policy is meant for, a registered id, or ``None`` (spaces from the dataset)
    :param dataset: Path(s) of HDF5 datasets, or a glob pattern
    :param learning_rate: learning rate of actor and critic, a float or a function of the remaining progress (from 1 to 0)
    :param batch_size: Transitions in a batch
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor
    :param n_steps: steps of rewards before the target's value (1: as above)
    :param temperature: lambda of the paper: the smaller, the more the best actions of a batch count
    :param n_action_samples: number of the policy's actions that V(s) is estimated with
    :param target_update_interval: update the target network every ``target_update_interval`` gradient steps
    :param reward_fn: rewards in place of the dataset's, see
        :class:`~sb3_offline.common.reward_based.RewardBasedAlgorithm`
    :param random_shift: images are shifted by up to so many pixels, alike in groups of 32 (0: no augmentation)
    :param n_stack: number of frames that the policy sees at once, as SB3's ``VecFrameStack`` stacks them
    :param dataset_storage: ``"memory"``, ``"mmap"``, or ``"auto"``
    :param stats_window_size: kept for SB3's signature
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    """

    _parameter_constraints: ClassVar[Mapping[str, Constraints]] = {"temperature": [POSITIVE], "n_action_samples": [COUNT]}
    search_space: ClassVar[SearchSpace] = {
        **BOOTSTRAPPING,
        "temperature": log_uniform(0.1, 10),
        "n_action_samples": Choice(1, 4, 10),
    }

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 1024,
        tau: float = 0.005,
        gamma: float = 0.99,
        n_steps: int = 1,
        temperature: float = 1.0,
        n_action_samples: int = 1,
        target_update_interval: int = 1,
        reward_fn: RewardFunction | None = None,
        random_shift: int = 0,
        n_stack: int = 1,
        dataset_storage: Literal["auto", "memory", "mmap"] = "auto",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy,
            env,
            dataset,
            reward_fn,
            learning_rate=learning_rate,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            n_steps=n_steps,
            target_update_interval=target_update_interval,
            random_shift=random_shift,
            n_stack=n_stack,
            dataset_storage=dataset_storage,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
        )
        self.temperature = temperature
        self.n_action_samples = n_action_samples

        if _init_setup_model:
            self._setup_model()

    def all_policy_kwargs(self) -> dict[str, Any]:
        return {"std_min": 0.05, **self.policy_kwargs}

    def train(self, gradient_steps: int, batch_size: int = 1024) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])

        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            observations = self.augment(batch.observations)
            features = self.critic.encode(observations)
            policy_features = self._policy_features(observations, features)
            with th.no_grad():
                rewards, discounts, next_observations = self._returns(batch)
                next_actions, _ = self.actor.sample(self.actor.encode(next_observations))
                next_values = self.critic_target.values(self.critic_target.encode(next_observations), next_actions)
                targets = rewards + discounts * next_values.amin(dim=0)
                policy_actions, _ = self.actor.sample(policy_features, self.n_action_samples)
                policy_values = self.critic.values(features, policy_actions)

            data_values = self.critic.values(features, batch.actions)
            critic_loss = bellman_loss(data_values, targets)
            self._optimize(self.critic.optimizer, critic_loss)

            advantages = sampled_advantages(data_values.detach(), policy_values)
            weights = softmax_weights(advantages, self.temperature)
            actor_loss = (weights * self.actor.regression_loss(policy_features, batch.actions)).mean()
            self._optimize(self.actor.optimizer, actor_loss)

            self._n_updates += 1
            self._update_target()
            self._record(
                critic_loss=critic_loss,
                actor_loss=actor_loss,
                values_data=data_values.mean(),
                values_policy=policy_values.mean(),
                advantage=advantages.mean(),
                effective_weights=effective_share(weights),
            )
