"""Stacks of the last frames of an episode, laid out as SB3's ``VecFrameStack`` lays them out."""

from collections import OrderedDict
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from sb3_offline.data.errors import DatasetError


def stacked_space(space: spaces.Space, n_stack: int) -> spaces.Space:
    """
    :param space: space of one frame: a Box, or a Dict of these
    :param n_stack: number of frames
    :return: space of their stack; the space itself for one frame. Raises ``TypeError`` if ``n_stack`` is no count, and
        ``DatasetError`` if the space is of another kind
    """
    check_n_stack(n_stack)
    if n_stack == 1:
        return space
    parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    for key, part in parts.items():
        if not isinstance(part, spaces.Box) or not part.shape:
            problem = f"{f'{key!r} ' if key else ''}is {part}, which has no frames that could be stacked"
            raise DatasetError("", "observation_space", problem, "Leave out n_stack, or wrap the environment")
    stacked = {key: StackedObservations(1, n_stack, part).stacked_observation_space for key, part in parts.items()}  # type: ignore
    return spaces.Dict(OrderedDict(stacked)) if isinstance(space, spaces.Dict) else stacked[""]


def check_n_stack(n_stack: int) -> None:
    """:param n_stack: number of frames in a stack; raises ``TypeError`` if it is no count"""
    if not isinstance(n_stack, int | np.integer) or isinstance(n_stack, bool) or n_stack < 1:
        raise TypeError(f"n_stack is {n_stack!r}; give a whole number of at least 1")


def frame_space(space: spaces.Space, n_stack: int) -> spaces.Space:
    """
    Undo :func:`stacked_space`.

    :param space: space of stacks, images channel-first or channel-last
    :param n_stack: number of frames in a stack
    :return: space of one frame, in the same layout; raises ``DatasetError`` if the space holds no such stacks
    """
    if n_stack == 1:
        return space
    if isinstance(space, spaces.Dict):
        return spaces.Dict(OrderedDict((key, frame_space(part, n_stack)) for key, part in space.spaces.items()))
    if not isinstance(space, spaces.Box) or not space.shape or space.shape[stack_axis(space)] % n_stack:
        problem = f"is {space}, which is no stack of {n_stack} frames"
        raise DatasetError("", "observation_space", problem, "Give n_stack as the environment's VecFrameStack has it")
    axis = stack_axis(space)
    first = np.arange(space.shape[axis] // n_stack)
    return spaces.Box(space.low.take(first, axis), space.high.take(first, axis), dtype=space.dtype.type)  # type: ignore


def stack_axis(space: spaces.Box) -> int:
    """:return: the axis of an observation along which its frames are joined: 0 for channel-first images, else -1"""
    return StackedObservations.compute_stacking(1, space)[3]


def joined_frames(frames: np.ndarray, axis: int) -> np.ndarray:
    """
    :param frames: ``(B, n_stack, *shape)``, the oldest frame of each stack first
    :param axis: 0 or -1, see :func:`stack_axis`
    :return: ``(B, *stacked shape)``
    """
    if axis == 0:
        return frames.reshape(len(frames), -1, *frames.shape[3:])
    moved = np.moveaxis(frames, 1, -2)
    return moved.reshape(*moved.shape[:-2], -1)


def repeated_frames(observations: Any, space: spaces.Space, n_stack: int) -> Any:
    """
    :param observations: ``(n, *shape)`` single frames, or a dict of such arrays
    :param space: space of one frame; of a Dict, keys may be missing in ``observations``
    :param n_stack: number of frames in a stack
    :return: stacks of each frame with itself: what is seen of a scene that rests
    """
    if n_stack == 1:
        return observations
    if isinstance(space, spaces.Dict):
        return {key: repeated_frames(part, space[key], n_stack) for key, part in observations.items()}
    assert isinstance(space, spaces.Box)
    return joined_frames(np.repeat(observations[:, None], n_stack, axis=1), stack_axis(space))


class EpisodeStack:
    """
    Stacks the observations of one environment without SB3's wrappers as ``VecFrameStack`` would.

    :param space: observation space of the environment
    :param n_stack: number of frames in a stack; 1 leaves observations as they are
    """

    def __init__(self, space: spaces.Space, n_stack: int):
        self._frames = StackedObservations(1, n_stack, space) if n_stack > 1 else None  # type: ignore[arg-type]

    def reset(self, observation: Any) -> Any:
        """
        :param observation: the first one of an episode
        :return: the stack of it: frames before the beginning are zeros
        """
        return observation if self._frames is None else _single(self._frames.reset(_batch(observation)))

    def add(self, observation: Any) -> Any:
        """
        :param observation: the next one of the episode
        :return: the stack of the last frames
        """
        if self._frames is None:
            return observation
        return _single(self._frames.update(_batch(observation), np.zeros(1, dtype=bool), [{}])[0])


def _batch(observation: Any) -> Any:
    if isinstance(observation, dict):
        return {key: np.asarray(part)[None] for key, part in observation.items()}
    return np.asarray(observation)[None]


def _single(batch: Any) -> Any:
    return {key: part[0].copy() for key, part in batch.items()} if isinstance(batch, dict) else batch[0].copy()
