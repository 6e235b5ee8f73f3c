"""ReBRAC: TD3+BC with a penalty of its own for the critics."""

import warnings
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_offline.common.hyperparameters import NOT_NEGATIVE, Constraints
from sb3_offline.common.reward_based import RewardFunction
from sb3_offline.common.search import BOOTSTRAPPING, SearchSpace, log_uniform
from sb3_offline.data.buffer import OfflineReplayBuffer, OfflineSamples
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import DatasetLike
from sb3_offline.rebrac.losses import penalized_actor_loss, penalized_values, squared_distances
from sb3_offline.td3_bc.base import OfflineTD3


class ReBRAC(OfflineTD3):
    """
    Revisited Behavior-Regularized Actor-Critic (ReBRAC, https://arxiv.org/abs/2305.09836): TD3+BC whose critics are penalized
    too, where the policy leaves the dataset's actions::

        y = r + gamma (1 - terminated) (min_i Qbar_i(s', a') - critic_bc_coef |a' - a'_D|^2)
            a' = clip(pibar(s') + noise),    noise ~ clip(N(0, target_policy_noise))
        critic:  min  sum_i E_D[(Q_i(s, a) - y)^2]
        actor:   min  E_D[actor_bc_coef |pi(s) - a|^2 - lambda min_i Q_i(s, pi(s))],    lambda = 1 / E_D|min_i Q_i(s, pi(s))|

    ``a'_D`` is the dataset's action at the next step. The last step of a truncated episode has none, so it is not learned
    from. The last step of a terminated one needs none, since its target is r.

    By default the networks have three hidden layers of 256 units, with a LayerNorm in each of the critics'.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment the policy is meant for, a registered id, or ``None`` (spaces from the dataset)
    :param dataset: Path(s) of HDF5 datasets, or a glob pattern
    :param learning_rate: learning rate of actor and critic, a float or a function of the remaining progress (from 1 to 0)
    :param batch_size: Transitions in a batch
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor
    :param n_steps: steps of rewards before the target's value (1: as above); the penalty is that of the action after them
    :param actor_bc_coef: beta_1 of the paper: weight of imitation in the actor's loss
    :param critic_bc_coef: beta_2 of the paper: weight of the penalty in the critics' targets, in units of the rewards
    :param policy_delay: gradient steps for each update of the actor and of the target networks
    :param target_policy_noise: standard deviation of the noise on the target's actions
    :param target_noise_clip: bound of that noise
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

    needs_next_actions = True
    _parameter_constraints: ClassVar[Mapping[str, Constraints]] = {
        "actor_bc_coef": [NOT_NEGATIVE],
        "critic_bc_coef": [NOT_NEGATIVE],
    }
    search_space: ClassVar[SearchSpace] = {
        **BOOTSTRAPPING,
        "actor_bc_coef": log_uniform(1e-3, 1),
        "critic_bc_coef": log_uniform(1e-4, 1),
    }
    _learnable: np.ndarray

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        learning_rate: float | Schedule = 1e-3,
        batch_size: int = 1024,
        tau: float = 0.005,
        gamma: float = 0.99,
        n_steps: int = 1,
        actor_bc_coef: float = 0.01,
        critic_bc_coef: float = 0.01,
        policy_delay: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
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
            policy_delay,
            target_policy_noise,
            target_noise_clip,
            learning_rate=learning_rate,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            n_steps=n_steps,
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
        self.actor_bc_coef = actor_bc_coef
        self.critic_bc_coef = critic_bc_coef

        if _init_setup_model:
            self._setup_model()

    def all_policy_kwargs(self) -> dict[str, Any]:
        return {"net_arch": [256, 256, 256], "critic_layer_norm": True, **self.policy_kwargs}

    def _on_data_opened(self, buffer: OfflineReplayBuffer) -> None:
        super()._on_data_opened(buffer)
        last = np.cumsum(np.concatenate([dataset.lengths for dataset in buffer.datasets])) - 1
        self._learnable = np.delete(np.arange(buffer.size()), last[buffer.dones[last] == 0])
        path = buffer.datasets[0].path
        if len(self._learnable) == 0:
            problem = "are all 1, and no episode terminated: ReBRAC needs the action that followed, and there is none"
            raise DatasetError(path, "episodes/length", problem, "Take TD3BC, which needs none")
        if buffer.rewards.any() and not buffer.rewards[self._learnable].any():
            warnings.warn(
                f"{path}: rewards: all of them are 0 but those of truncated episodes' last steps, which ReBRAC does not learn "
                "from, since no action follows. If success ends an episode, record that as terminated; or take TD3BC."
            )

    def _sample_batch(self, batch_size: int) -> OfflineSamples:
        buffer = self.replay_buffer
        indices = self._learnable[buffer.rng.integers(0, len(self._learnable), batch_size)]
        return buffer.transitions(indices, self._vec_normalize_env)

    def _target_values(self, next_values: th.Tensor, next_actions: th.Tensor, batch: OfflineSamples) -> th.Tensor:
        data_actions = batch.horizons[-1].next_actions
        assert data_actions is not None
        distances = squared_distances(next_actions, data_actions)
        self._record(critic_penalty=self.critic_bc_coef * distances.mean())
        return penalized_values(next_values, distances, self.critic_bc_coef)

    def _actor_loss(self, values: th.Tensor, actions: th.Tensor, data_actions: th.Tensor) -> th.Tensor:
        policy_values = values.amin(dim=0)
        distances = squared_distances(actions, data_actions)
        self._record(imitation_loss=distances.mean(), values_policy=policy_values.mean())
        return penalized_actor_loss(policy_values, distances, self.actor_bc_coef)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_learnable"]
