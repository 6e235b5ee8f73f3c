"""Replay buffers of Stable-Baselines3: in memory, or pickled by ``model.save_replay_buffer``."""

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.foreign.base import Foreign, Format, Options
from sb3_offline.data.foreign.episodes import cut_episodes, follows, lengths_so_far
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.format import Header
from sb3_offline.data.spaces import subspaces

# `timeouts` is not required, since old versions of SB3 saved buffers without it.
REQUIRED = ("observations", "actions", "rewards", "dones")


def recognizes(probe: Probe) -> bool:
    """
    :param probe: a path or an object
    :return: whether it is a replay buffer, or a pickle of a class that may be one. Whether a pickled class is derived from
        ``ReplayBuffer`` shows only when it is loaded
    """
    if probe.is_object:
        return isinstance(probe.given, ReplayBuffer)
    package, *rest = probe.pickled.split(".")
    return bool(rest) and package not in ("builtins", "collections", "numpy")


def read(probe: Probe, options: Options) -> Foreign:
    """
    Read an SB3 ``ReplayBuffer``, or one of its subclasses, into memory.

    Unpickling a file runs the code that it names, as SB3's own ``load_replay_buffer`` does: open only files that you trust.

    The steps of each environment follow one another, oldest first. What the buffer has overwritten is missing: the beginning
    of the oldest episode and, with ``optimize_memory_usage``, the last observations of episodes, see
    :func:`~sb3_offline.data.foreign.episodes.cut_episodes`. In a buffer without ``timeouts``
    (``handle_timeout_termination=False``), each end of an episode counts as a termination.

    :param probe: the buffer or the file
    :param options: ``max_episode_steps``: in a buffer without ``timeouts``, complete episodes of that length were truncated
    :return: the data
    """
    path = probe.path
    buffer = _checked(probe.given if probe.is_object else _unpickle(path), path)
    optimized, n = bool(buffer.optimize_memory_usage), buffer.size()
    order = np.roll(np.arange(buffer.buffer_size), -buffer.pos) if buffer.full else np.arange(n)
    if optimized and buffer.full:
        order = order[1:]  # the observation after the newest step overwrote that of the oldest step
    if len(order) == 0:
        raise DatasetError(path, "pos", "says that the buffer is empty", "Save it after the model has collected steps")

    def rows(array: np.ndarray) -> np.ndarray:
        """:return: the rows of all environments, one environment after another"""
        return np.concatenate([array[order, index] for index in range(buffer.n_envs)])

    header = Header(
        buffer.observation_space,
        buffer.action_space,
        provenance={"format": f"SB3 {type(buffer).__name__}", "n_envs": buffer.n_envs},
        success=False,
    )
    plain = subspaces(buffer.observation_space, "observations")

    def columns(arrays: Any, take: Any) -> dict[str, np.ndarray]:
        parts = {name: arrays[name.removeprefix("observations/")] if isinstance(arrays, dict) else arrays for name in plain}
        return {name: take(part).reshape(-1, *(plain[name].shape or ())) for name, part in parts.items()}

    observations = columns(buffer.observations, rows)
    newest = np.zeros(len(order) * buffer.n_envs, dtype=bool)
    newest[len(order) - 1 :: len(order)] = True
    dones = rows(buffer.dones).astype(bool)
    if optimized:
        following = columns(buffer.observations, lambda array: rows(np.roll(array, -1, axis=0)))
        broken = newest
    else:
        following = columns(buffer.next_observations, rows)
        # An episode also ends where the environment was reset without being done, as at the start of each `learn`
        broken = newest | ~follows(observations, following)
    timeouts = rows(buffer.timeouts).astype(bool) if hasattr(buffer, "timeouts") else np.zeros_like(dones)
    ends = dones | broken
    if not getattr(buffer, "handle_timeout_termination", False) and options.max_episode_steps:
        timeouts |= dones & (lengths_so_far(ends) == options.max_episode_steps)
    steps = {
        "actions": _unscaled(rows(buffer.actions), buffer.action_space, path),
        "rewards": rows(buffer.rewards),
        "terminated": dones & ~timeouts,
        "truncated": dones & timeouts,
    }
    known = newest if optimized else np.ones_like(newest)
    arrays = cut_episodes(
        header, path, observations=observations, next_observations=following, known=known, ends=ends, steps=steps
    )
    return Foreign(header, arrays)


def _unpickle(path: Path) -> Any:
    try:
        return load_from_pkl(path)
    except (pickle.UnpicklingError, EOFError, AttributeError, ImportError, IndexError, ValueError) as error:
        remedy = "Save it again with model.save_replay_buffer, and read it with the packages that it was saved with"
        raise DatasetError(path, "file", f"cannot be unpickled ({error})", remedy) from error


def _checked(buffer: Any, path: Path) -> ReplayBuffer:
    if not isinstance(buffer, ReplayBuffer) or not all(hasattr(buffer, name) for name in REQUIRED):
        problem = f"is a {type(buffer).__module__}.{type(buffer).__name__}, not a ReplayBuffer of Stable-Baselines3"
        raise DatasetError(path, "replay buffer", problem, "Give a buffer of SB3, or a file of model.save_replay_buffer")
    return buffer


def _unscaled(actions: np.ndarray, space: spaces.Space, path: os.PathLike) -> np.ndarray:
    """:return: actions in the units of the environment. SB3's buffers hold the actions of a Box scaled to [-1, 1]"""
    actions = actions.reshape(-1, *(space.shape or ()))
    if not isinstance(space, spaces.Box):
        return actions
    if np.abs(actions).max() > 1 + 1e-5:
        problem = f"reach from {actions.min():.4g} to {actions.max():.4g}, but SB3 stores them scaled to [-1, 1]"
        raise DatasetError(
            path, "actions", problem, "Fill the buffer through SB3's learn(), or scale them (policy.scale_action)"
        )
    return space.low + 0.5 * (actions + 1.0) * (space.high - space.low)


FORMAT = Format(
    name="Stable-Baselines3",
    description="a ReplayBuffer, or a file of model.save_replay_buffer",
    recognizes=recognizes,
    read=read,
    declares_spaces=True,
    unpickles=True,
)
