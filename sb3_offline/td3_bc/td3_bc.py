"""TD3+BC: TD3 with a term of behavioral cloning."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import polyak_update
from torch.nn import functional as F

from sb3_offline.common.hyperparameters import COUNT, NOT_NEGATIVE, Constraints
from sb3_offline.common.losses import bellman_loss
from sb3_offline.common.reward_based import RewardBasedAlgorithm, RewardFunction
from sb3_offline.common.search import BOOTSTRAPPING, SearchSpace, Uniform, UniformInt, log_uniform
from sb3_offline.data.reader import DatasetSource
from sb3_offline.td3_bc.policies import CnnPolicy, DeterministicActor, MlpPolicy, MultiInputPolicy, TD3BCPolicy


class TD3BC(RewardBasedAlgorithm):
    """
    TD3+BC (https://arxiv.org/abs/2106.06860) is TD3 with an actor that also imitates the dataset::

        y = r + gamma (1 - terminated) min_i Qbar_i(s', clip(pibar(s') + noise)),    noise ~ clip(N(0, target_policy_noise))
        critic:  min  sum_i E_D[(Q_i(s, a) - y)^2]
        actor:   min  E_D[-lambda Q_1(s, pi(s)) + (pi(s) - a)^2],    lambda = alpha / E_D|Q_1(s, pi(s))|

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment the policy is meant for, a registered id, or ``None`` (spaces from the dataset)
    :param dataset: Path(s) of HDF5 datasets, or a glob pattern
    :param learning_rate: learning rate of actor and critic, a float or a function of the remaining progress (from 1 to 0)
    :param batch_size: Transitions in a batch
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor
    :param n_steps: steps of rewards before the target's value (1: as above)
    :param alpha: weight of the values against imitation: 0 for behavioral cloning
    :param policy_delay: actor and target networks are updated once in so many gradient steps
    :param target_policy_noise: standard deviation of the noise on the target's actions
    :param target_noise_clip: bound of that noise
    :param reward_fn: rewards in place of the dataset's, see
        :class:`~sb3_offline.common.reward_based.RewardBasedAlgorithm`
    :param random_shift: images are shifted by up to so many pixels, alike in groups of 32 (0: no augmentation)
    :param dataset_storage: ``"memory"``, ``"mmap"``, or ``"auto"``
    :param stats_window_size: kept for SB3's signature
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    _parameter_constraints: ClassVar[Mapping[str, Constraints]] = {
        "alpha": [NOT_NEGATIVE],
        "policy_delay": [COUNT],
        "target_policy_noise": [NOT_NEGATIVE],
        "target_noise_clip": [NOT_NEGATIVE],
    }
    search_space: ClassVar[SearchSpace] = {
        **BOOTSTRAPPING,
        "alpha": log_uniform(0.5, 10),
        "policy_delay": UniformInt(1, 3),
        "target_policy_noise": Uniform(0, 0.5),
    }
    policy: TD3BCPolicy
    actor: DeterministicActor  # type: ignore[assignment]
    actor_target: DeterministicActor

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetSource | None = None,
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        n_steps: int = 1,
        alpha: float = 2.5,
        policy_delay: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        reward_fn: RewardFunction | None = None,
        random_shift: int = 0,
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
            random_shift=random_shift,
            dataset_storage=dataset_storage,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
        )
        self.alpha = alpha
        self.policy_delay = policy_delay
        self.target_policy_noise = target_policy_noise
        self.target_noise_clip = target_noise_clip

        if _init_setup_model:
            self._setup_model()

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
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            observations = self.augment(batch.observations)
            features = self.critic.encode(observations)
            with th.no_grad():
                rewards, discounts, next_observations = self._returns(batch)
                next_features = self.critic_target.encode(next_observations)
                shared = self.policy.share_features_extractor
                next_actions = self.actor_target.act(next_features if shared else self.actor_target.encode(next_observations))
                noise = self._target_noise(next_actions)
                next_values = self.critic_target.values(next_features, (next_actions + noise).clamp(-1, 1))
                targets = rewards + discounts * next_values.amin(dim=0)

            values = self.critic.values(features, batch.actions)
            critic_loss = bellman_loss(values, targets)
            self._optimize(self.critic.optimizer, critic_loss)
            self._record(critic_loss=critic_loss, values_data=values.mean())

            self._n_updates += 1
            if self._n_updates % self.policy_delay == 0:
                actions = self.actor.act(self._policy_features(observations, features))
                policy_values = self._values_of_policy(features, actions)[0]
                imitation_loss = F.mse_loss(actions, batch.actions)
                actor_loss = imitation_loss - self.alpha / policy_values.abs().mean().detach() * policy_values.mean()
                self._optimize(self.actor.optimizer, actor_loss)
                self._record(actor_loss=actor_loss, imitation_loss=imitation_loss, values_policy=policy_values.mean())
            self._update_target()

    def _target_noise(self, actions: th.Tensor) -> th.Tensor:
        """:return: like ``actions``: noise that smooths the target over similar actions"""
        noise = self.target_policy_noise * th.randn_like(actions)
        return noise.clamp(-self.target_noise_clip, self.target_noise_clip)

    def _update_target(self) -> None:
        super()._update_target()
        if self._n_updates % self.policy_delay == 0:
            # The target of a shared encoder is the critic's, which is updated already.
            heads = (m if not self.policy.share_features_extractor else m.mu for m in (self.actor, self.actor_target))
            source, target = (head.parameters() for head in heads)
            polyak_update(source, target, self.tau)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "actor_target"]
