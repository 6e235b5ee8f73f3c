"""Episodes as pictures."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw
from stable_baselines3.common.type_aliases import PolicyPredictor

FRAME_MS = 80
LAST_FRAME_MS = 800


def record_episode(
    model: PolicyPredictor, env_id: str, env_kwargs: dict[str, Any], seed: int, size: int = 200
) -> tuple[list[np.ndarray], bool]:
    """
    :param model: plays its mode
    :param env_id: registered id
    :param env_kwargs: of the environment
    :param seed: of the episode
    :param size: width and height of the frames, in pixels
    :return: frames ``(size, size, 3)`` uint8, one a decision, until the task is solved and a little longer; and whether it was
    """
    env = gym.make(env_id, render_mode="rgb_array", width=size, height=size, **env_kwargs)
    observation, _ = env.reset(seed=seed)
    frames, solved_for, done = [env.render()], 0, False
    while not done and solved_for < 5:
        action, _ = model.predict(observation, deterministic=True)
        observation, _, terminated, truncated, info = env.step(action)
        frames.append(env.render())
        done = terminated or truncated
        solved_for += bool(info["is_success"])
    env.close()
    return frames, solved_for > 0  # type: ignore[return-value]


def record_gif(
    model: PolicyPredictor, env_id: str, env_kwargs: dict[str, Any], path: Path, n_episodes: int = 3, seed: int = 100_000
) -> list[bool]:
    """
    The first episodes from a seed on, whatever comes of them, one after the other in a GIF.

    :param model: plays its mode
    :param env_id: registered id
    :param env_kwargs: of the environment
    :param path: of the GIF
    :param n_episodes: how many
    :param seed: of the first
    :return: which of them were solved
    """
    pictures, durations, outcomes = [], [], []
    for index in range(n_episodes):
        frames, solved = record_episode(model, env_id, env_kwargs, seed + index)
        outcomes.append(solved)
        for number, frame in enumerate(frames):
            picture = Image.fromarray(frame)
            last = number == len(frames) - 1
            text = f"episode {index + 1}" + (f": {'solved' if solved else 'failed'}" if last else "")
            ImageDraw.Draw(picture).text((6, 4), text, fill=(255, 255, 255), stroke_width=1, stroke_fill=(0, 0, 0))
            pictures.append(picture.quantize(128, dither=Image.Dither.NONE))
            durations.append(LAST_FRAME_MS if last else FRAME_MS)
    path.parent.mkdir(parents=True, exist_ok=True)
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations, loop=0, optimize=True)
    return outcomes
