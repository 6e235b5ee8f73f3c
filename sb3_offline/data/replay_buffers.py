"""SB3's replay buffers, as ``model.save_replay_buffer`` pickles them."""

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.flat import cut_episodes, follows, lengths_so_far
from sb3_offline.data.format import Header
from sb3_offline.data.spaces import subspaces


def read_replay_buffer(path: Path, max_episode_steps: int | None = None) -> tuple[Header, dict[str, Any]]:
    """
    Read an SB3 ``ReplayBuffer`` (or one of its subclasses) into memory, as the arrays of our format.

    Unpickling runs what the file says, as SB3's own ``load_replay_buffer`` does: open no file that you do not trust.

    The steps of each of its environments follow one another, oldest first. What the buffer has no longer is not there: of
    the oldest episode its beginning, and with ``optimize_memory_usage`` the observations that episodes ended with (see
    :func:`~sb3_offline.data.flat.cut_episodes`). Where it holds no ``timeouts`` (``handle_timeout_termination=False``), an
    episode that ends counts as terminated.

    :param path: the pickle
    :param max_episode_steps: the environment's time limit: without ``timeouts``, whole episodes of that length were truncated
    :return: header and arrays by name, as ``Header.fields`` names them
    """
    buffer = _unpickle(path)
    optimized, n = bool(buffer.optimize_memory_usage), buffer.size()
    order = np.roll(np.arange(buffer.buffer_size), -buffer.pos) if buffer.full else np.arange(n)
    if optimized and buffer.full:
        order = order[1:]  # the observation of the oldest step gave way to that after the newest
    if len(order) == 0:
        raise DatasetError(path, "pos", "says that the buffer is empty", "Save it after the model has collected steps")

    def rows(array: np.ndarray) -> np.ndarray:
        """All environments one after another"""
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
        # Also where the environment was reset without being done, as each `learn` does
        broken = newest | ~follows(observations, following)
    timeouts = rows(buffer.timeouts).astype(bool)
    ends = dones | broken
    if not buffer.handle_timeout_termination and max_episode_steps:
        timeouts |= dones & (lengths_so_far(ends) == max_episode_steps)
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
    return header, arrays


def _unpickle(path: Path) -> ReplayBuffer:
    try:
        buffer = load_from_pkl(path)
    except FileNotFoundError as error:
        raise DatasetError(path, "file", "does not exist", "Check the path") from error
    except (pickle.UnpicklingError, EOFError, AttributeError, ImportError, IndexError, ValueError) as error:
        remedy = "Save it again with model.save_replay_buffer, and read it with the packages that it was saved with"
        raise DatasetError(path, "file", f"cannot be unpickled ({error})", remedy) from error
    if not (isinstance(buffer, ReplayBuffer) and hasattr(buffer, "dones") and hasattr(buffer, "timeouts")):
        problem = f"holds a {type(buffer).__module__}.{type(buffer).__name__}, no ReplayBuffer of Stable-Baselines3"
        raise DatasetError(path, "file", problem, "Give what model.save_replay_buffer wrote")
    return buffer


def _unscaled(actions: np.ndarray, space: spaces.Space, path: os.PathLike) -> np.ndarray:
    """Actions in the environment's units: SB3's buffers hold those of a Box scaled to [-1, 1]."""
    actions = actions.reshape(-1, *(space.shape or ()))
    if not isinstance(space, spaces.Box):
        return actions
    if np.abs(actions).max() > 1 + 1e-5:
        problem = f"reach from {actions.min():.4g} to {actions.max():.4g}, but SB3 stores them scaled to [-1, 1]"
        raise DatasetError(
            path, "actions", problem, "Fill the buffer through SB3's learn(), or scale them (policy.scale_action)"
        )
    return space.low + 0.5 * (actions + 1.0) * (space.high - space.low)
