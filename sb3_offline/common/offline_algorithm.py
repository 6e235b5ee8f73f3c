"""The base of all algorithms: SB3's off-policy class, which draws batches from a dataset instead of an environment."""

import sys
import time
import warnings
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common import utils
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, PyTorchObs, Schedule
from stable_baselines3.common.vec_env import VecNormalize, unwrap_vec_normalize

from sb3_offline.common.augmentation import has_images, shift_observations
from sb3_offline.common.frame_stack import saved_n_stack, stacked_env
from sb3_offline.common.hyperparameters import COUNT, SHARE, WHOLE, Constraints, check_parameters
from sb3_offline.common.learning_data import LearningData
from sb3_offline.common.normalization import NormalizerStatistics, exceeds_clipping, normalizer_from, normalizes, statistics_of
from sb3_offline.common.process import prepare_process
from sb3_offline.common.search import LEARNING, SearchSpace
from sb3_offline.common.stub_env import SpacesOnlyEnv
from sb3_offline.data.buffer import OfflineReplayBuffer, OfflineSamples
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import DatasetLike
from sb3_offline.data.stacking import stacked_space

SelfOfflineAlgorithm = TypeVar("SelfOfflineAlgorithm", bound="OfflineAlgorithm")


class OfflineAlgorithm(OffPolicyAlgorithm):
    """
    The base for offline algorithms: batches come from an HDF5 dataset, and the environment is neither reset nor stepped
    while learning. One timestep is one gradient step.

    Everything around it is SB3's: callbacks, logger, ``save``/``load``, ``predict``, ``evaluate_policy``.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: The environment the policy is meant for: an env, a vectorized env, a registered id, or ``None``, which takes
        the spaces from the dataset. It is used for its spaces only (and, where it is a ``VecNormalize``, its observation
        statistics are fitted to the dataset).
    :param dataset: Path of a dataset, a glob pattern, an ``OfflineDataset``, data in memory (SB3's ``ReplayBuffer``, a
        ``MinariDataset``, a dict of arrays with D4RL's names, a list of trajectory dicts), or a list of these. Paths are saved
        with the model; data in memory are not
    :param learning_rate: learning rate for the optimizers, a float or a function of the remaining progress (from 1 to 0)
    :param batch_size: Transitions in a batch
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor
    :param n_steps: length of the n-step windows that ``train()`` may use; windows never cross an episode
    :param target_update_interval: update the target network every ``target_update_interval`` gradient steps
    :param random_shift: images are shifted by up to so many pixels, edges repeated (0: no augmentation)
    :param n_stack: number of frames that the policy sees at once, the last ones of the episode. An environment that is not in
        SB3's ``VecFrameStack`` is put into one, and so is whatever the policy is evaluated in
    :param dataset_storage: ``"memory"``, ``"mmap"``, or ``"auto"``, which maps the file where it does not fit in memory
    :param policy_kwargs: additional arguments to be passed to the policy on creation
    :param stats_window_size: kept for SB3's signature
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param device: Device (cpu, cuda, ...) on which the code should be run.
    :param seed: Seed for the pseudo random generators; the buffer draws batches from one of its own
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {}
    #: whether ``train()`` needs the dataset's action at the next step (an episode's last step is then its own successor)
    needs_next_actions: bool = False
    #: constraints on the constructor's arguments; a subclass lists those of its own arguments
    _parameter_constraints: ClassVar[Mapping[str, Constraints]] = {
        "batch_size": [COUNT],
        "tau": [SHARE],
        "gamma": [SHARE],
        "n_steps": [COUNT],
        "target_update_interval": [COUNT],
        "random_shift": [WHOLE],
        "n_stack": [COUNT],
    }
    #: what a hyperparameter search draws from
    search_space: ClassVar[SearchSpace] = LEARNING
    #: what :meth:`values` are called in figures; ``None`` for an algorithm without a critic
    value_name: ClassVar[str | None] = None

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
        target_update_interval: int = 1,
        random_shift: int = 0,
        n_stack: int = 1,
        dataset_storage: Literal["auto", "memory", "mmap"] = "auto",
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        device: th.device | str = "auto",
        seed: int | None = None,
    ):
        self._data = LearningData(self)  # before SB3's constructor, which sets `replay_buffer`
        if env is None and dataset is not None:
            opened = self._data.datasets(dataset)[0]
            env = SpacesOnlyEnv(stacked_space(opened.observation_space, n_stack), opened.action_space)
        elif env is not None:
            env = stacked_env(env, n_stack)
        super().__init__(
            policy,
            env,  # type: ignore[arg-type]
            learning_rate,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            n_steps=n_steps,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            support_multi_env=True,
            sde_support=False,
        )
        if env is not None and not isinstance(self.action_space, spaces.Box):
            source = dataset if isinstance(dataset, str | PathLike) else ""
            remedy = "Use an environment, and data of it, with a Box of actions"
            problem = f"is {self.action_space}, but {type(self).__name__} learns continuous actions (Box) only"
            raise DatasetError(source, "action_space", problem, remedy)
        # A plain attribute, so that `load(path, dataset=...)` can replace it; opened when the first batch is drawn.
        self.dataset = dataset
        self.dataset_storage = dataset_storage
        self.target_update_interval = target_update_interval
        self.random_shift = random_shift
        self.n_stack = n_stack
        self._sampler_state: dict[str, Any] | None = None
        # Of a saved model, until it goes on learning
        self._torch_rng_state: th.Tensor | None = None
        self._cuda_rng_state: th.Tensor | None = None
        self._observations_normalized = False  # by a VecNormalize, when it learned
        self._saved_normalizer: NormalizerStatistics | None = None  # of that VecNormalize
        self._metrics: dict[str, tuple[th.Tensor, int]] = {}

    def _setup_model(self) -> None:
        if not hasattr(self, "observation_space"):
            raise TypeError(f"{type(self).__name__} needs `dataset=` or `env=` to know its observation and action spaces")
        check_parameters(self)
        self._setup_lr_schedule()
        super().set_random_seed(self.seed)  # a loaded model keeps the states of its generators
        if self.env is None:
            self.env = self._wrap_env(SpacesOnlyEnv(self.observation_space, self.action_space))
        policy_kwargs = self.all_policy_kwargs()
        self.policy = self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **policy_kwargs)
        self.policy = self.policy.to(self.device)
        if self.random_shift and not has_images(self.observation_space, not self.policy.normalize_images):
            problem = f"{type(self).__name__}: random_shift shifts images, and there are none in {self.observation_space}"
            raise TypeError(f"{problem}; leave it out")
        self._convert_train_freq()
        self._create_aliases()

    def all_policy_kwargs(self) -> dict[str, Any]:
        """
        :return: the user's ``policy_kwargs``, and the algorithm's own where they say nothing
        """
        return self.policy_kwargs

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor  # type: ignore[assignment]

    # ------------------------------------------------------------------ data

    @property
    def replay_buffer(self) -> OfflineReplayBuffer:  # type: ignore[override]
        """The dataset as SB3's replay buffer. It is opened at the first use, and again if an input was replaced since."""
        return self._data.open()

    @replay_buffer.setter
    def replay_buffer(self, buffer: ReplayBuffer | None) -> None:
        self._data.adopt(buffer)

    def _open_data(self) -> None:
        """Open and check all inputs before learning starts."""
        self._data.open()

    def _data_inputs(self) -> tuple[Any, ...]:
        """:return: the attributes that the buffer depends on: the data are opened again after one of these is replaced"""
        return (self.dataset,)

    def relabel(self, buffer: OfflineReplayBuffer) -> None:
        """
        Replace the rewards of a buffer by those that this algorithm learns from, if it learns from others.

        :param buffer: over the model's own dataset, or over held-out data
        """

    def _on_data_opened(self, buffer: OfflineReplayBuffer) -> None:
        """Called when the data are open, fitted and relabelled, before the first batch is drawn."""

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        env = stacked_env(env, self.n_stack)  # type: ignore[assignment]
        if self._data.buffer is not None:  # before the environment is replaced
            self._data.check_normalizer(unwrap_vec_normalize(env))  # type: ignore[arg-type]
        normalizer = self._vec_normalize_env
        super().set_env(env, force_reset)
        if self._vec_normalize_env is not normalizer:
            self._data.prepare_again()

    def observation_normalizer(self) -> VecNormalize | None:
        """
        The statistics that the policy learned with. Whatever plays the policy in a plain environment has to normalise
        observations by them before :meth:`predict`, as the environment did that the model learned with.

        :return: a VecNormalize whose ``normalize_obs`` does this; ``None`` if the policy learned from plain observations.
            Raises ``RuntimeError`` if the statistics are missing: the model was loaded from a zip of an earlier version
            without its environment
        """
        normalizer = self._vec_normalize_env
        if normalizes(normalizer):
            return normalizer
        if not self._observations_normalized:
            return None
        if self._saved_normalizer is None:
            self._data.check_normalizer(normalizer)
        assert self._saved_normalizer is not None
        return normalizer_from(self._saved_normalizer, self.observation_space, self.action_space)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        See :meth:`stable_baselines3.common.base_class.BaseAlgorithm.predict`. As with all of SB3, a model that learned with a
        ``VecNormalize`` takes observations that are normalised already. Plain ones are refused where they cannot be
        normalised ones: ``RuntimeError`` for values outside the bounds that ``VecNormalize`` clips to.
        """
        if self._observations_normalized:
            normalizer = self._vec_normalize_env if normalizes(self._vec_normalize_env) else self._saved_normalizer
            if normalizer is not None and exceeds_clipping(observation, normalizer):
                raise RuntimeError(
                    "The policy learned from observations that a VecNormalize normalised, and these are not normalised; "
                    "normalise them first: model.observation_normalizer().normalize_obs(observation)"
                )
        return super().predict(observation, state, episode_start, deterministic)

    def set_random_seed(self, seed: int | None = None) -> None:
        super().set_random_seed(seed)
        if seed is None:
            return
        # The model starts anew instead of going on as the saved one would have
        self._torch_rng_state, self._sampler_state = None, dict(np.random.default_rng(seed).bit_generator.state)
        self._data.restore_generator()

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        """
        Go on from a saved buffer: with its place in the data, if it is over the model's own dataset, or with its dataset,
        if the model has none.

        :param path: of the file that ``save_replay_buffer`` wrote. A buffer of an online algorithm of SB3 is a dataset, which
            a model without a dataset takes
        :param truncate_last_traj: see :class:`~stable_baselines3.common.off_policy_algorithm.OffPolicyAlgorithm`
        """
        super().load_replay_buffer(path, truncate_last_traj)
        saved, self.replay_buffer = self._data.buffer, None
        if not isinstance(saved, OfflineReplayBuffer):
            if self.dataset is not None or not isinstance(path, str | PathLike):
                problem = f"is a {type(saved).__name__}, which holds no place in this model's dataset to go on from"
                raise DatasetError(path, "replay buffer", problem, "Learn from it: dataset=PATH")
            self.dataset = path if Path(path).suffix else f"{path}.pkl"
            self._open_data()
            return
        if self.dataset is None:
            self.dataset = saved.datasets
        if not self._data.go_on_from(saved):
            warnings.warn(f"{path}: is over other data than the model's dataset; the model goes on with its own dataset.")

    def augment(self, observations: PyTorchObs, max_shift: int | None = None) -> PyTorchObs:
        """
        :param observations: a batch as the buffer gives it
        :param max_shift: largest shift in pixels (default: ``random_shift``)
        :return: the batch with its images shifted
        """
        max_shift = self.random_shift if max_shift is None else max_shift
        images_are_floats = not self.policy.normalize_images
        return shift_observations(observations, self.observation_space, max_shift, self.replay_buffer.rng, images_are_floats)

    # ------------------------------------------------- answers about the model

    def default_callbacks(self) -> list[BaseCallback]:
        """:return: new callbacks that every training of this algorithm should have"""
        return []

    def values(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor | None:
        """
        What the critics make of actions, in the unit that :attr:`value_name` names. No gradient.

        :param observations: a batch, as the buffer gives it
        :param actions: ``(batch, action_dim)`` in [-1, 1]
        :return: the lowest of the critics, ``(batch,)``; ``None`` without a critic
        """
        return None

    def td_errors(self, batch: OfflineSamples) -> th.Tensor | None:
        """
        Errors of the critics in the Bellman equation of the learned policy. No gradient.

        :param batch: transitions
        :return: absolute errors, the mean over the critics, ``(batch,)``; ``None`` without a critic
        """
        return None

    def success_probabilities(self, observations: PyTorchObs, actions: th.Tensor | None = None) -> th.Tensor | None:
        """
        What a classifier of success makes of observations. No gradient.

        :param observations: a batch, as the buffer gives it
        :param actions: ``(batch, action_dim)`` in [-1, 1]; default: the policy's
        :return: probabilities, ``(batch,)``; ``None`` for an algorithm without such a classifier
        """
        return None

    # -------------------------------------------------------------- learning

    def learn(  # type: ignore[override]
        self: SelfOfflineAlgorithm,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1000,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfOfflineAlgorithm:
        """
        Return a trained model.

        :param total_timesteps: The number of gradient steps
        :param callback: callback(s) called after every gradient step
        :param log_interval: gradient steps between two dumps of the log (``None``: never)
        :param tb_log_name: the name of the run for TensorBoard logging (default: the algorithm's)
        :param reset_num_timesteps: whether or not to reset the current timestep number (used in logging)
        :param progress_bar: Display a progress bar using tqdm and rich.
        :return: the trained model
        """
        tb_log_name = tb_log_name or type(self).__name__
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        self._open_data()  # before callbacks replace what an earlier run left
        callback.on_training_start(locals(), globals())

        while self.num_timesteps < total_timesteps:
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            self.train(gradient_steps=1, batch_size=self.batch_size)
            self.num_timesteps += 1
            self._on_step()
            callback.update_locals(locals())
            if not callback.on_step():
                break
            if log_interval is not None and self.num_timesteps % log_interval == 0:
                self.dump_logs()

        if self._metrics and log_interval is not None:
            self.dump_logs()
        callback.on_training_end()
        return self

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        # SB3's own version resets the environment, which an offline learner must never do.
        prepare_process()
        self.start_time = time.time_ns()
        if reset_num_timesteps:
            self.num_timesteps = 0
        else:
            total_timesteps += self.num_timesteps
        self._total_timesteps = total_timesteps
        self._num_timesteps_at_start = self.num_timesteps
        self._metrics = {}
        if self._torch_rng_state is not None:
            th.set_rng_state(self._torch_rng_state)
            if self._cuda_rng_state is not None and self.device.type == "cuda":
                th.cuda.set_rng_state(self._cuda_rng_state, self.device)
            self._torch_rng_state = self._cuda_rng_state = None
        if not self._custom_logger:
            self._logger = utils.configure_logger(self.verbose, self.tensorboard_log, tb_log_name, reset_num_timesteps)
        return total_timesteps, self._init_callback(callback, progress_bar)

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        callback = super()._init_callback(callback, progress_bar)
        _count_gradient_steps(callback)
        return callback

    def _on_step(self) -> None:
        """Called after each gradient step, before the callbacks."""

    @staticmethod
    def _optimize(optimizer: th.optim.Optimizer, loss: th.Tensor) -> None:
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    # --------------------------------------------------------------- logging

    def _record(self, **metrics: th.Tensor) -> None:
        """Add scalars to the means of the next log dump, without waiting for the device."""
        for name, value in metrics.items():
            total, count = self._metrics.get(name, (0.0, 0))
            self._metrics[name] = (total + value.detach(), count + 1)  # type: ignore[assignment]

    def dump_logs(self) -> None:
        """Write the means since the last dump to the logger."""
        time_elapsed = max((time.time_ns() - self.start_time) / 1e9, sys.float_info.epsilon)
        fps = int((self.num_timesteps - self._num_timesteps_at_start) / time_elapsed)
        for name, (total, count) in self._metrics.items():
            self.logger.record(f"train/{name}", float(total) / count)
        self._metrics = {}
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("time/fps", fps)
        self.logger.record("time/time_elapsed", int(time_elapsed), exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(step=self.num_timesteps)

    # ---------------------------------------------------------------- saving

    def save(self, path: Any, exclude: Any = None, include: Any = None) -> None:
        if self._data.buffer is not None:
            self._sampler_state = self._data.buffer.get_rng_state()
        if normalizes(self._vec_normalize_env):
            self._saved_normalizer = statistics_of(self._vec_normalize_env)  # type: ignore[arg-type]
        # With these, a loaded model goes on as this one would: PyTorch's generator of the device draws the actions.
        self._torch_rng_state = th.get_rng_state()
        self._cuda_rng_state = th.cuda.get_rng_state(self.device) if self.device.type == "cuda" else None
        super().save(path, exclude, include)
        self._torch_rng_state = self._cuda_rng_state = None

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfOfflineAlgorithm],
        path: Any,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfOfflineAlgorithm:
        """
        Load a saved model, which goes on learning as the saved one would have.

        :param path: as :meth:`stable_baselines3.common.base_class.BaseAlgorithm.load` takes it, and all arguments but these
        :param kwargs: attributes to replace, such as ``dataset``, ``examples`` or ``reward_fn``; with ``seed`` it goes on with
            other batches and actions
        :return: the model
        """
        if env is not None:
            env = stacked_env(env, saved_n_stack(path))  # type: ignore[assignment]
        model = super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        if kwargs.get("seed") is not None:
            model.set_random_seed(kwargs["seed"])
        return model

    def _excluded_save_params(self) -> list[str]:
        excluded = [*super()._excluded_save_params(), "actor", "_data", "_metrics"]
        # Paths are kept, so that a loaded model can go on learning. Data in memory would be copied into the file.
        parts = self.dataset if isinstance(self.dataset, list | tuple) else [self.dataset]
        only_paths = all(part is None or isinstance(part, str | PathLike) for part in parts)
        return excluded if only_paths else [*excluded, "dataset"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor.optimizer"], []


def _count_gradient_steps(callback: BaseCallback, seen: set[int] | None = None) -> None:
    """
    Make SB3's progress bars show the timesteps of the model. SB3 adds the number of environments to a bar at each step, but a
    timestep here is one gradient step, whatever the number of environments.

    :param callback: a progress bar, or a callback that may contain some
    :param seen: identities of the callbacks that need no second visit
    """
    seen = set() if seen is None else seen
    seen.add(id(callback))
    if type(callback)._on_step is ProgressBarCallback._on_step:
        bar: Any = callback

        def on_step() -> bool:
            bar.pbar.update(bar.model.num_timesteps - bar.model._num_timesteps_at_start - bar.pbar.n)
            return True

        bar._on_step = on_step
    for value in vars(callback).values():
        for inner in value if isinstance(value, list) else [value]:
            if isinstance(inner, BaseCallback) and id(inner) not in seen:
                _count_gradient_steps(inner, seen)
