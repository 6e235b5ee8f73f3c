"""What callbacks share."""

from collections.abc import Mapping

from stable_baselines3.common.callbacks import BaseCallback


def log_at_once(callback: BaseCallback, values: Mapping[str, float]) -> None:
    """
    Log values under the present step. Left to the next dump, they would stand under a later step, or be overwritten before it.

    :param callback: whose
    :param values: by their names
    """
    for name, value in values.items():
        callback.logger.record(name, value)
    callback.logger.record("time/total_timesteps", callback.num_timesteps, exclude="tensorboard")
    callback.logger.dump(callback.num_timesteps)
