"""A replay buffer over datasets on disk."""

import warnings
import zlib
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.preprocessing import get_obs_shape
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.common.vec_env import VecNormalize

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import DatasetLike, OfflineDataset, open_datasets
from sb3_offline.data.spaces import same_actions, subspaces
from sb3_offline.data.stacking import frame_space, joined_frames, stack_axis
from sb3_offline.data.storage import RowStore, observation_stores

STATISTICS_BYTES = 1 << 24
Observations = th.Tensor | TensorDict


class Horizon(NamedTuple):
    """
    The outcome of B transitions after n' steps, where n' is smaller than asked for if an episode ends earlier.

    :param observations: observations after the n' steps, as ``OfflineSamples.observations``
    :param rewards: (B, 1) float, the sum of ``gamma ** k * reward`` over the n' steps
    :param dones: (B, 1) float, 1 where the last of the n' steps terminated
    :param discounts: (B, 1) ``gamma ** n'``
    :param next_actions: (B, A) the dataset's actions in ``observations``, if the buffer gives next actions
    """

    observations: Observations
    rewards: th.Tensor
    dones: th.Tensor
    discounts: th.Tensor
    next_actions: th.Tensor | None = None


class OfflineSamples(NamedTuple):
    """
    A batch of B transitions. The first six fields are those of SB3's ``ReplayBufferSamples``, for one step.

    :param observations: ``(B, *shape)``, channel-first images as a channels-last view of uint8
    :param actions: (B, A) scaled to [-1, 1]
    :param next_observations: as ``observations``
    :param dones: (B, 1) float, 1 where the step terminated; 0 where it was only truncated
    :param rewards: (B, 1) float, zeros where the files have none
    :param discounts: (B, 1) gamma
    :param horizons: the transitions' outcomes: after 1 step, and after ``n_steps`` steps if the buffer's ``n_steps`` is
        above 1. The last one is the longest.
    :param indices: (B,) int64 on the CPU, indices of the transitions for :meth:`OfflineReplayBuffer.transitions`
    """

    observations: Observations
    actions: th.Tensor
    next_observations: Observations
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor
    horizons: tuple[Horizon, ...] = ()
    indices: th.Tensor | None = None


class Pairs(NamedTuple):
    """
    B pairs of observation and action, without what followed.

    :param observations: as ``OfflineSamples.observations``
    :param actions: (B, A) scaled to [-1, 1]
    :param indices: (B,) int64 on the CPU, indices of their transitions
    """

    observations: Observations
    actions: th.Tensor
    indices: th.Tensor


class OfflineReplayBuffer(ReplayBuffer):
    """
    A fixed ``ReplayBuffer`` over one or several dataset files.

    It samples steps uniformly with its own random generator. Windows of several steps never cross an episode. It pickles as
    the paths of its files, the state of its generator, and the relabelled rewards, if any.

    :param dataset: path, glob pattern, ``OfflineDataset``, or a sequence of these
    :param observation_space: the learner's space: as in the files, or with images channel-first
    :param action_space: the learner's action space; must be that of the files
    :param device: where samples go
    :param n_steps: length of the second horizon of a batch, which exists for n_steps > 1
    :param gamma: discount of one step
    :param storage: "memory", "mmap" (contiguous files only), or "auto": the latter where the observations would take more than
        half of the available memory
    :param n_stack: number of frames in an observation, as SB3's ``VecFrameStack`` stacks them: the last ones of the episode,
        and zeros before its beginning. ``observation_space`` is then that of the stacks. Each frame is stored once
    :param next_actions: whether to give the dataset's next actions. The last step of an episode has no next action, so windows
        end at it, and it is its own successor. Thus a learner bootstraps only from pairs of observation and action that it
        also trains on. If the last steps were left out, their values would be bootstrapped but never trained
    :param seed: seed of the generator
    """

    def __init__(
        self,
        dataset: DatasetLike,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        *,
        n_steps: int = 1,
        gamma: float = 0.99,
        storage: Literal["auto", "memory", "mmap"] = "auto",
        n_stack: int = 1,
        next_actions: bool = False,
        seed: int | None = None,
    ):
        if n_steps < 1:
            raise ValueError(f"n_steps is {n_steps}; windows have one step at least")
        datasets = open_datasets(dataset)
        n_steps_total = sum(d.n_steps for d in datasets)
        # Not ReplayBuffer's constructor, which would allocate arrays for the transitions
        BaseBuffer.__init__(self, max(n_steps_total, 1), observation_space, action_space, device)
        self.full, self.optimize_memory_usage, self.handle_timeout_termination = True, False, False
        self.n_steps, self.gamma, self.next_actions = n_steps, gamma, next_actions
        self.datasets, self.n_stack = datasets, n_stack
        self._frame_space = frame_space(observation_space, n_stack)
        self._transposed = check_learner_spaces(datasets[0], self._frame_space, action_space)
        self._index_steps(self.lengths)
        self.actions = self._scaled_actions()
        self.rewards = self._file_rewards = self._concatenate("rewards", np.zeros(n_steps_total, np.float32))
        self.dones = self._concatenate("terminated").astype(np.float32)
        self._stores, self.storage = observation_stores(datasets, storage)
        self.rng = np.random.default_rng(seed)

    def _concatenate(self, name: str, default: np.ndarray | None = None) -> np.ndarray:
        if default is not None and name not in self.datasets[0].arrays:
            return default
        return np.concatenate([d.arrays[name] for d in self.datasets])

    def _index_steps(self, lengths: np.ndarray) -> None:
        """Compute for every step its row of observations and the number of steps that are left in its episode."""
        n, starts = int(lengths.sum()), np.cumsum(lengths) - lengths
        step = np.arange(n)
        self._observation_rows = step + np.repeat(np.arange(len(lengths)), lengths)
        if self.n_stack > 1:  # the number of earlier frames of the episode, for each row of observations
            first_rows = starts + np.arange(len(lengths))
            self._earlier_frames = np.arange(n + len(lengths)) - np.repeat(first_rows, lengths + 1)
        # The number of steps that a window may go ahead: 0 only at last steps, if next actions are asked for
        self._steps_left = np.repeat(starts + lengths, lengths) - step - int(self.next_actions)
        if n == 0:
            raise DatasetError(
                self.datasets[0].path, "episodes/length", "holds no episode", "Collect or convert the data again"
            )

    def _scaled_actions(self) -> np.ndarray:
        """:return: the actions as SB3's buffers hold them: scaled to [-1, 1] for a Box, integers otherwise"""
        actions = self._concatenate("actions").reshape(-1, self.action_dim)
        if not isinstance(self.action_space, spaces.Box):
            return actions
        low, high = (b.reshape(-1).astype(np.float64) for b in (self.action_space.low, self.action_space.high))
        path = self.datasets[0].path
        if not (np.isfinite(low) & np.isfinite(high)).all():
            remedy = "Bound the actions of the environment (gymnasium.wrappers.RescaleAction)"
            raise DatasetError(path, "action_space", "has infinite bounds, so actions cannot be scaled", remedy)
        if not (low < high).all():
            problem = f"leaves no choice in dimension {int(np.argmin(low < high))} (low equals high)"
            remedy = "Leave it out of the actions (gymnasium.ActionWrapper), in the environment and in the data"
            raise DatasetError(path, "action_space", problem, remedy)
        scaled = 2.0 * ((actions - low) / (high - low)) - 1.0
        outside = (np.abs(scaled) > 1 + 1e-4).any(axis=1)
        if outside.any():
            warnings.warn(
                f"{path}: actions: {outside.mean():.1%} of the actions are outside of the action space; they are clipped."
            )
        return np.clip(scaled, -1, 1).astype(np.float32)

    def size(self) -> int:
        """:return: the number of steps to sample from"""
        return self.buffer_size

    def reset(self) -> None:
        """Do nothing, since the data are fixed."""

    def add(self, *args: Any, **kwargs: Any) -> None:
        """Raise ``DatasetError``, since the data are fixed."""
        remedy = "Collect new steps in a ReplayBuffer of their own, or write a dataset with DatasetWriter"
        raise DatasetError("", "OfflineReplayBuffer", "is read-only", remedy)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> OfflineSamples:  # type: ignore[override]
        """
        :param batch_size: number of transitions B
        :param env: normalises observations and rewards
        :return: steps drawn uniformly, with replacement
        """
        return self.transitions(self.rng.integers(0, self.buffer_size, batch_size), env)

    def sample_pairs(self, batch_size: int, env: VecNormalize | None = None) -> Pairs:
        """
        :param batch_size: number of pairs B
        :param env: normalises observations
        :return: the observations and actions of the same transitions that :meth:`sample` would draw
        """
        indices = self.rng.integers(0, self.buffer_size, batch_size)
        return Pairs(*self.pairs(indices, env), th.as_tensor(indices))

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> OfflineSamples:  # type: ignore[override]
        return self.transitions(batch_inds, env)  # the name that SB3 knows

    def transitions(self, indices: np.ndarray, env: VecNormalize | None = None) -> OfflineSamples:
        """
        :param indices: (B,) indices of steps below ``size()``, counted through all files in their order
        :param env: normalises observations and rewards
        :return: these transitions, in this order
        """
        rows = self._observation_rows[indices]
        following = np.minimum(1, self._steps_left[indices])  # 0 where the last step of an episode is its own successor
        observations = self._observations(rows, env)
        one_step = Horizon(
            observations=self._observations(rows + following, env),
            rewards=self._column(self._normalize_reward(self.rewards[indices], env)),
            dones=self._column(self.dones[indices]),
            discounts=self._column(np.full(len(indices), self.gamma)),
            next_actions=self._scaled_actions_at(indices + following) if self.next_actions else None,
        )
        return OfflineSamples(
            observations=observations,
            actions=self._scaled_actions_at(indices),
            next_observations=one_step.observations,
            dones=one_step.dones,
            rewards=one_step.rewards,
            discounts=one_step.discounts,
            horizons=(one_step, self._window(indices, rows, env)) if self.n_steps > 1 else (one_step,),
            indices=th.as_tensor(indices),
        )

    def single_steps(self) -> "OfflineReplayBuffer":
        """
        :return: a buffer over the same arrays, without windows and next actions, whose last steps have their true successors
        """
        other = object.__new__(type(self))  # a copy would read the files again
        other.__dict__.update(self.__dict__, n_steps=1, next_actions=False)
        other._index_steps(self.lengths)
        return other

    def pairs(self, indices: np.ndarray, env: VecNormalize | None = None) -> tuple[Observations, th.Tensor]:
        """
        :param indices: (B,) indices of steps, as for :meth:`transitions`
        :param env: normalises observations
        :return: ``observations`` and ``actions`` of these transitions
        """
        return self._observations(self._observation_rows[indices], env), self._scaled_actions_at(indices)

    @property
    def lengths(self) -> np.ndarray:
        """The numbers of steps of all episodes, (E,) int64, through all files in their order."""
        return np.concatenate([dataset.lengths for dataset in self.datasets])

    def observations_at(self, rows: np.ndarray, env: VecNormalize | None = None) -> Observations:
        """
        Read observations without transitions. An episode of n steps has n + 1 rows: episode e begins at row
        ``lengths[:e].sum() + e``.

        :param rows: (B,) indices of observations below ``size() + len(lengths)``, counted through all files in their order
        :param env: normalises the observations
        :return: these observations, in this order, as ``OfflineSamples.observations``
        """
        return self._observations(rows, env)

    def _scaled_actions_at(self, indices: np.ndarray) -> th.Tensor:
        return self._to_device(self.actions.take(indices, axis=0))

    def _window(self, indices: np.ndarray, rows: np.ndarray, env: VecNormalize | None) -> Horizon:
        """:return: the outcome after ``n_steps`` steps, or at the end of the episode"""
        following = np.minimum(self.n_steps, self._steps_left[indices])
        n = np.maximum(following, 1)
        offsets = np.arange(self.n_steps)
        inside = offsets < n[:, None]
        window = indices[:, None] + np.where(inside, offsets, 0)  # rewards outside are masked, so any valid index will do
        rewards = self._normalize_reward(self.rewards[window], env) * inside * self.gamma**offsets
        return Horizon(
            observations=self._observations(rows + following, env),
            rewards=self._column(rewards.sum(axis=1)),
            dones=self._column(self.dones[indices + n - 1]),
            discounts=self._column(self.gamma**n),
            next_actions=self._scaled_actions_at(indices + following) if self.next_actions else None,
        )

    def _observations(self, rows: np.ndarray, env: VecNormalize | None) -> Observations:
        parts = {}
        for name, space in subspaces(self.observation_space, "observations").items():
            stored = self._stores[name].take(rows) if self.n_stack == 1 else self._stacks(name, rows)
            parts[name.removeprefix("observations/")] = self._wrap(name, stored, space)
        if env is not None:
            normalized = env.normalize_obs(parts if isinstance(self.observation_space, spaces.Dict) else parts["observations"])
            parts = normalized if isinstance(normalized, dict) else {"observations": normalized}
        tensors = {key: self._to_device(array) for key, array in parts.items()}
        return tensors if isinstance(self.observation_space, spaces.Dict) else tensors["observations"]

    def _stacks(self, name: str, rows: np.ndarray) -> np.ndarray:
        """:return: the stacks that end in rows of observations, in the layout of the file"""
        back = np.arange(self.n_stack - 1, -1, -1)
        is_inside = back <= self._earlier_frames[rows][:, None]
        frame_rows = rows[:, None] - np.where(is_inside, back, 0)  # a frame before the episode is blank, so any row will do
        frames = self._stores[name].take(frame_rows.ravel())
        frames = frames.reshape(*frame_rows.shape, *frames.shape[1:])
        frames[~is_inside] = 0
        return joined_frames(frames, -1 if name in self._transposed else self._stack_axis(name))

    def _stack_axis(self, name: str) -> int:
        return stack_axis(subspaces(self._frame_space, "observations")[name])  # type: ignore[arg-type]

    def _wrap(self, name: str, array: np.ndarray, space: spaces.Space) -> np.ndarray:
        """:return: rows of a file in the layout and dtype of the learner's space; images become channel-first as a view"""
        if name in self._transposed:
            return array.transpose(0, 3, 1, 2)
        return array.reshape(len(array), *_plain_shape(space)).astype(space.dtype, copy=False)

    def _to_device(self, array: np.ndarray) -> th.Tensor:
        return th.as_tensor(array, device=self.device)  # no copy on the CPU, since all arrays here are new

    def _column(self, values: np.ndarray) -> th.Tensor:
        return self._to_device(values.astype(np.float32).reshape(-1, 1))

    @property
    def has_rewards(self) -> bool:
        """True if there are rewards, in the files or in their place."""
        return self.is_relabelled or self.datasets[0].rewards is not None

    def restore_rewards(self) -> None:
        """Go back to the rewards of the files."""
        self.rewards = self._file_rewards

    @property
    def is_relabelled(self) -> bool:
        """True if the rewards are not those of the files."""
        return self.rewards is not self._file_rewards

    def success_rewards(self) -> np.ndarray:
        """
        :return: (N,) float32, 1 for the steps that the files label as successes; raises ``DatasetError`` if they hold no
            labels
        """
        for dataset in self.datasets:
            if dataset.success is None:
                raise DatasetError(dataset.path, "success", "is missing: the file has no success labels", "Give other rewards")
        return self._concatenate("success").astype(np.float32)

    def relabel(
        self, reward_fn: Callable[[OfflineSamples], Any], env: VecNormalize | None = None, batch_size: int = 512
    ) -> None:
        """
        Replace all rewards in memory. The files stay unchanged.

        :param reward_fn: function that returns the rewards (B,) of a batch of one-step transitions, as a tensor or an array.
            It is called without gradients, once for each transition, in their order
        :param env: normalises the observations of the batches
        :param batch_size: transitions in a batch
        """
        rewards = np.empty(self.buffer_size, np.float32)
        n_steps, self.n_steps = self.n_steps, 1  # no windows, which would only read more images
        try:
            for first in range(0, self.buffer_size, batch_size):
                indices = np.arange(first, min(first + batch_size, self.buffer_size))
                with th.no_grad():
                    values = th.as_tensor(reward_fn(self.transitions(indices, env))).to("cpu", th.float32)
                if values.shape not in ((len(indices),), (len(indices), 1)) or not values.isfinite().all():
                    problem = f"gave {values} of shape {tuple(values.shape)} for {len(indices)} transitions"
                    raise DatasetError("", "reward_fn", problem, "Return one finite number for each transition")
                rewards[indices] = values.flatten().numpy()
        finally:
            self.n_steps = n_steps
        self.rewards = rewards

    def return_variance(self, gamma: float) -> float:
        """
        Compute the variance by which ``VecNormalize`` scales rewards: that of the discounted sum of the rewards up to a step.

        :param gamma: discount factor of ``VecNormalize``
        :return: the variance over all steps
        """
        lengths = self.lengths
        starts, returns = np.cumsum(lengths) - lengths, self.rewards.astype(np.float64)
        for t in range(1, int(lengths.max())):
            steps = starts[lengths > t] + t
            returns[steps] += gamma * returns[steps - 1]
        return float(returns.var())

    def observation_statistics(self, keys: Sequence[str] | None = None) -> Any:
        """
        Compute the moments of all observations, including the last ones of episodes, for instance for
        ``VecNormalize.obs_rms``.

        :param keys: keys of a Dict space (default: all)
        :return: (mean, variance, count), with mean and variance float64 of the learner's shape; a dict of these for a Dict
            space. Stacked frames all have the moments of the frames: the blank ones at the beginning do not count
        """
        plain = subspaces(self._frame_space, "observations")
        names = {n.removeprefix("observations/"): n for n in plain}
        moments = {key: self._moments(n, self._stores[n], plain[n]) for key, n in names.items() if not keys or key in keys}
        return moments if isinstance(self.observation_space, spaces.Dict) else moments["observations"]

    def _moments(self, name: str, store: RowStore, space: spaces.Space) -> tuple[np.ndarray, np.ndarray, int]:
        mean, squares, count = np.zeros(()), np.zeros(()), 0
        for part in store.parts:
            rows = max(STATISTICS_BYTES // max(part[:1].nbytes, 1), 1)
            for first in range(0, len(part), rows):
                piece = self._wrap(name, part[first : first + rows], space).astype(np.float64)
                delta, total = piece.mean(axis=0) - mean, count + len(piece)
                # Join the moments of two sets (Chan et al.). Plain sums of squares would cancel for means far from 0
                squares = squares + ((piece - piece.mean(axis=0)) ** 2).sum(axis=0) + delta**2 * count * len(piece) / total
                mean = mean + delta * len(piece) / total
                count = total
        variance = squares / count
        if self.n_stack > 1:
            frames = (np.repeat(moment[None, None], self.n_stack, axis=1) for moment in (mean, variance))
            mean, variance = (joined_frames(part, self._stack_axis(name))[0] for part in frames)
        return mean, variance, count

    def checksum(self) -> int:
        """:return: a checksum of all actions, an identifier of the data"""
        return zlib.crc32(self.actions.tobytes())

    def get_rng_state(self) -> dict[str, Any]:
        """:return: the state of the generator, for an exact resume"""
        return dict(self.rng.bit_generator.state)

    def set_rng_state(self, state: dict[str, Any]) -> None:
        """:param state: a state that ``get_rng_state`` returned"""
        self.rng.bit_generator.state = state

    def __getstate__(self) -> dict[str, Any]:
        names = ("n_steps", "gamma", "storage", "n_stack", "next_actions")
        options = {name: getattr(self, name) for name in names}
        arguments = (self.datasets, self.observation_space, self.action_space, str(self.device))
        rewards = self.rewards if self.is_relabelled else None  # no file holds relabelled rewards
        return {"arguments": arguments, "options": options, "rng_state": self.get_rng_state(), "rewards": rewards}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["arguments"], **state["options"])  # type: ignore[misc]
        self.set_rng_state(state["rng_state"])
        self.rewards = self.rewards if state["rewards"] is None else state["rewards"]


def joined(batches: Sequence[Observations]) -> Observations:
    """:return: the batches as one"""
    if isinstance(batches[0], dict):
        return {key: th.cat([batch[key] for batch in batches]) for key in batches[0]}  # type: ignore[index, call-overload]
    return th.cat(list(batches))  # type: ignore[arg-type]


def _plain_shape(space: spaces.Space) -> tuple[int, ...]:
    """:return: SB3's shape of one observation of a plain space: (1,) for Discrete"""
    return get_obs_shape(space)  # type: ignore[return-value]


def check_learner_spaces(
    dataset: OfflineDataset, observation_space: spaces.Space | None = None, action_space: spaces.Space | None = None
) -> set[str]:
    """
    :param dataset: an open dataset
    :param observation_space: the learner's space of single frames; ``None`` is not checked
    :param action_space: the learner's space; ``None`` is not checked
    :return: names of the arrays of images that are channel-last in the files and channel-first for the learner; raises
        ``DatasetError`` if the data do not fit the learner
    """
    transposed = set() if observation_space is None else _match_observations(dataset, observation_space)
    if action_space is not None and not same_actions(dataset.action_space, action_space):
        problem = f"is {dataset.action_space}, but the learner has {action_space}"
        remedy = "Use the environment that the data were collected in"
        if dataset.guessed_actions:
            remedy = "The file declares no bounds: give OfflineDataset(path, action_space=...)"
        raise DatasetError(dataset.path, "action_space", problem, remedy)
    return transposed


def _match_observations(dataset: OfflineDataset, space: spaces.Space) -> set[str]:
    """:return: names of the arrays of images that are channel-last in the files and channel-first for the learner"""
    stored, wanted = subspaces(dataset.observation_space, "observations"), subspaces(space, "observations")
    if stored.keys() != wanted.keys():
        problem = f"is {dataset.observation_space}, but the learner has {space}"
        raise DatasetError(dataset.path, "observation_space", problem, "Use the environment that the data were collected in")
    transposed = set()
    for name, part in wanted.items():
        fits = True
        shape, learner = tuple(stored[name].shape or ()), tuple(part.shape or ())
        if len(shape) == 3 and shape != learner and (shape[2], shape[0], shape[1]) == learner:
            transposed.add(name)
        elif isinstance(part, spaces.Box) and isinstance(stored[name], spaces.Box):
            fits = shape == learner and np.dtype(stored[name].dtype).kind == np.dtype(part.dtype).kind
        else:
            fits = stored[name] == part  # the same values, not only as many columns
        if not fits:
            problem = f"is {stored[name]}, but the learner has {part}"
            raise DatasetError(
                dataset.path, name, problem, "Use the environment (and wrappers) that the data were collected in"
            )
    return transposed
