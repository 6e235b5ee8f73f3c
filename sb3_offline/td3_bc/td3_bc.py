"""TD3+BC: TD3 with a term of behavioral cloning."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from torch.nn import functional as F

from sb3_offline.common.hyperparameters import NOT_NEGATIVE, Constraints
from sb3_offline.common.reward_based import RewardFunction
from sb3_offline.common.search import BOOTSTRAPPING, SearchSpace, Uniform, UniformInt, log_uniform
from sb3_offline.data.reader import DatasetLike
from sb3_offline.td3_bc.base import OfflineTD3


class TD3BC(OfflineTD3):
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

    _parameter_constraints: ClassVar[Mapping[str, Constraints]] = {"alpha": [NOT_NEGATIVE]}
    search_space: ClassVar[SearchSpace] = {
        **BOOTSTRAPPING,
        "alpha": log_uniform(0.5, 10),
        "policy_delay": UniformInt(1, 3),
        "target_policy_noise": Uniform(0, 0.5),
    }

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
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
        self.alpha = alpha

        if _init_setup_model:
            self._setup_model()

    def _actor_loss(self, values: th.Tensor, actions: th.Tensor, data_actions: th.Tensor) -> th.Tensor:
        policy_values = values[0]
        imitation_loss = F.mse_loss(actions, data_actions)
        self._record(imitation_loss=imitation_loss, values_policy=policy_values.mean())
        return imitation_loss - self.alpha / policy_values.abs().mean().detach() * policy_values.mean()
