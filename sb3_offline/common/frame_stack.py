"""Environments whose observations are stacks of frames, for models that learn from stacks."""

import io
import json
import zipfile
from typing import Any

from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.save_util import open_path
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecFrameStack, VecNormalize

from sb3_offline.data.stacking import check_n_stack


def stacked_env(env: GymEnv | str, n_stack: int) -> GymEnv | str:
    """
    :param env: an env, a vectorized env, or a registered id
    :param n_stack: number of frames in a stack
    :return: the environment in a ``VecFrameStack``, unless it is in one already; the environment itself for one frame. Raises
        ``TypeError`` if it stacks another number of frames, or if a ``VecNormalize`` normalises single frames: that must be
        around the stacks
    """
    check_n_stack(n_stack)
    if n_stack == 1:
        return env
    made: Any = maybe_make_env(env, 0)
    vec_env: VecEnv = made if isinstance(made, VecEnv) else DummyVecEnv([lambda: Monitor(made)])
    wrappers: list[Any] = []
    inner: Any = vec_env
    while isinstance(inner, VecEnvWrapper):
        wrappers, inner = [*wrappers, inner], inner.venv
    stack = next((index for index, wrapper in enumerate(wrappers) if isinstance(wrapper, VecFrameStack)), None)
    if stack is not None and (found := wrappers[stack].stacked_obs.n_stack) != n_stack:
        raise TypeError(f"The environment's VecFrameStack stacks {found} frames; give n_stack={found}, not {n_stack}")
    if any(isinstance(wrapper, VecNormalize) for wrapper in wrappers[stack:]):
        problem = "the environment's VecNormalize normalises single frames, and the model sees stacks"
        raise TypeError(f"n_stack={n_stack}: {problem}; give VecNormalize(VecFrameStack(env, {n_stack}))")
    return VecFrameStack(vec_env, n_stack) if stack is None else vec_env


def saved_n_stack(path: Any) -> int:
    """
    :param path: a zip of SB3's ``save``: its path, or an open file
    :return: the number of frames that the saved model sees at once
    """
    file = path if isinstance(path, io.IOBase) else open_path(path, "r", verbose=0, suffix="zip")
    try:
        with zipfile.ZipFile(file) as archive:
            return int(json.loads(archive.read("data")).get("n_stack", 1))
    except (zipfile.BadZipFile, KeyError, ValueError, AttributeError, TypeError):
        return 1  # SB3 says what is wrong with the file
    finally:
        if file is path:
            file.seek(0)
        else:
            file.close()
