"""Environments, registered with gymnasium by id; what an environment needs is imported only when it is made."""

import gymnasium as gym

ENV_ID = "MultimodalMetaworld-v0"

if ENV_ID not in gym.registry:
    # No max_episode_steps: the environment truncates by itself, after its `episode_length`.
    gym.register(ENV_ID, entry_point="sb3_offline.envs.multimodal_metaworld:MultimodalMetaworldEnv")
