"""Behavioral cloning."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_offline.bc.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_offline.common.hyperparameters import Constraints, Options
from sb3_offline.common.offline_algorithm import OfflineAlgorithm
from sb3_offline.common.policies import OfflineActor
from sb3_offline.common.search import LEARNING, Choice, SearchSpace
from sb3_offline.data.reader import DatasetLike


class BC(OfflineAlgorithm):
    """
    Behavioral cloning (BC): imitates the whole dataset, ``max E_D[log pi(a | s)]``, or ``min E_D[(tanh(mean(s)) - a)^2]``.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment the policy is meant for, a registered id, or ``None`` (spaces from the dataset)
    :param dataset: Path(s) of HDF5 datasets, or a glob pattern
    :param learning_rate: learning rate, a float or a function of the remaining progress (from 1 to 0)
    :param batch_size: Transitions in a batch
    :param loss: ``"mse"``: squared error of the policy's mode (its standard deviation is fitted by likelihood), or
        ``"log_prob"``: likelihood of both
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

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    _parameter_constraints: ClassVar[Mapping[str, Constraints]] = {"loss": [Options(("log_prob", "mse"))]}
    search_space: ClassVar[SearchSpace] = {**LEARNING, "loss": Choice("mse", "log_prob")}
    actor: OfflineActor

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 256,
        loss: str = "mse",
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
            learning_rate=learning_rate,
            batch_size=batch_size,
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
        self.loss = loss

        if _init_setup_model:
            self._setup_model()

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.actor.optimizer)

        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            features = self.actor.encode(self.augment(batch.observations))
            if self.loss == "mse":
                actor_loss = self.actor.regression_loss(features, batch.actions).mean()
            else:
                actor_loss = -self.actor.log_prob(features, batch.actions).mean()
            self._optimize(self.actor.optimizer, actor_loss)

            self._n_updates += 1
            self._record(actor_loss=actor_loss)
