"""The paper's table gives the same bytes as when its published results were made."""

import hashlib
import importlib.metadata
import json
import platform
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import sb3_offline.envs  # noqa: F401

pytest.importorskip("metaworld")

from sb3_offline.envs.multimodal_metaworld import TASKS

RECORDED = json.loads((Path(__file__).parent / "files" / "paper_table_hashes.json").read_text())


def hashes(env):
    """Of a short episode of random actions: all that a learner or a dataset can get from it."""
    digests = {name: hashlib.sha256() for name in ("observations", "rewards", "successes", "scene_states")}

    def add(observation, reward, info):
        digests["observations"].update(observation.tobytes())
        digests["rewards"].update(np.float64(reward).tobytes() + info["task_reward"].tobytes())
        digests["successes"].update(info["task_success"].tobytes() + bytes([info["success"], info["is_success"]]))
        digests["scene_states"].update(env.unwrapped.scene.get_state().tobytes())

    rng = np.random.default_rng(0)
    observation, info = env.reset(seed=3)
    add(observation, 0.0, info)
    for _ in range(10):
        observation, reward, _, _, info = env.step(rng.uniform(-1.2, 1.2, 4).astype(np.float32))
        add(observation, reward, info)
    return {name: digest.hexdigest()[:16] for name, digest in digests.items()}


@pytest.mark.parametrize("obs_type", ["state", "pixels"])
def test_every_byte_of_the_paper_table_is_as_recorded(obs_type):
    here = {name: importlib.metadata.version(name) for name in ("mujoco", "metaworld")} | {"machine": platform.machine()}
    if here != {name: RECORDED[name] for name in here}:
        pytest.skip(f"recorded with other versions or on another kind of machine than {here}")
    for task in TASKS:
        env = gym.make("MultimodalMetaworld-v0", task=task, obs_type=obs_type)
        if obs_type == "pixels" and env.unwrapped.get_render_device() != RECORDED["device"]:
            pytest.skip(f"images were recorded on {RECORDED['device']}")
        assert hashes(env) == RECORDED["hashes"][f"{task}/{obs_type}"], task
        env.close()
