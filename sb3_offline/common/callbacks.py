"""Logging from callbacks."""

from collections.abc import Mapping

from stable_baselines3.common.callbacks import BaseCallback


def log_at_once(callback: BaseCallback, values: Mapping[str, float]) -> None:
    """
    Log values under the present step. With the next regular dump they would appear under a later step, or be overwritten.

    :param callback: the callback that logs
    :param values: values by name
    """
    for name, value in values.items():
        callback.logger.record(name, value)
    callback.logger.record("time/total_timesteps", callback.num_timesteps, exclude="tensorboard")
    callback.logger.dump(callback.num_timesteps)
