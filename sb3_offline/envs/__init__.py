"""Environments, registered with gymnasium by id. Their dependencies are imported only when an environment is made."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym

ENV_ID = "MultimodalMetaworld-v0"

if ENV_ID not in gym.registry:
    # No max_episode_steps: the environment itself truncates after its `episode_length`.
    gym.register(ENV_ID, entry_point="sb3_offline.envs.multimodal_metaworld:MultimodalMetaworldEnv")


def lacks_task(env_id: str, env_kwargs: Mapping[str, Any]) -> bool:
    """
    :param env_id: id of an environment to evaluate in
    :param env_kwargs: its keyword arguments
    :return: True where these do not say which of the environment's tasks is meant
    """
    return env_id == ENV_ID and "task" not in env_kwargs
