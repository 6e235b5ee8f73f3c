"""Record episodes as images."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw
from stable_baselines3.common.type_aliases import PolicyPredictor

from sb3_offline.data.files import replacing
from sb3_offline.data.stacking import EpisodeStack
from sb3_offline.experiment.evaluation import EVALUATION_SEED, PlainObservationPredictor, frames_seen_by

FRAME_MS = 80
LAST_FRAME_MS = 800


def record_episode(model: PolicyPredictor, env: gym.Env, seed: int | None = None) -> tuple[list[np.ndarray], int | None]:
    """
    Play one episode with the mode of a policy, until the task is solved and a little longer.

    :param model: a model or a policy
    :param env: environment with ``render_mode="rgb_array"``
    :param seed: seed of the episode; ``None`` continues with the environment's own generator
    :return: frames uint8, before the first decision and after each; and the index of the decision that solved the task, or
        ``None``
    """
    player, stack = PlainObservationPredictor(model), EpisodeStack(env.observation_space, frames_seen_by(model))
    observation = stack.reset(env.reset(seed=seed)[0])
    frames, solved_at, solved_for, done = [env.render()], None, 0, False
    while not done and solved_for < 5:
        action, _ = player.predict(observation, deterministic=True)
        frame, _, terminated, truncated, info = env.step(action)
        observation = stack.add(frame)
        frames.append(env.render())
        done = terminated or truncated
        solved_for += bool(info.get("is_success"))
        if solved_for == 1 and solved_at is None:
            solved_at = len(frames) - 1
    return frames, solved_at  # type: ignore[return-value]


def make_recording_env(env_id: str, env_kwargs: dict[str, Any], size: int) -> gym.Env:
    """
    :param env_id: registered id of the environment
    :param env_kwargs: keyword arguments of the environment
    :param size: width and height of the images, if the environment takes ``width`` and ``height``
    :return: an environment that renders images; raises ``RuntimeError`` if it cannot
    """
    arguments = {**env_kwargs, "render_mode": "rgb_array"}
    try:
        return gym.make(env_id, **{"width": size, "height": size, **arguments})
    except TypeError:  # the environment takes no size
        pass
    try:
        return gym.make(env_id, **arguments)
    except TypeError as error:
        raise RuntimeError(f"{env_id} renders no images ({error})") from error


def record_gif(
    model: PolicyPredictor,
    env_id: str,
    env_kwargs: dict[str, Any],
    path: Path,
    n_episodes: int = 3,
    seed: int = EVALUATION_SEED,
    size: int = 200,
) -> list[bool]:
    """
    Record episodes one after the other in a GIF. They are the first episodes, unselected, that
    :func:`~sb3_offline.experiment.evaluation.evaluate_success` plays with this seed.

    :param model: a model or a policy, which plays its mode
    :param env_id: registered id of the environment
    :param env_kwargs: keyword arguments of the environment
    :param path: the GIF
    :param n_episodes: number of episodes
    :param seed: seed of the first episode; the others continue with the same generator
    :param size: width and height in pixels
    :return: for each episode, True if it was solved
    """
    env = make_recording_env(env_id, env_kwargs, size)
    images, durations, outcomes = [], [], []
    for index in range(n_episodes):
        frames, solved_at = record_episode(model, env, seed if index == 0 else None)
        solved = solved_at is not None
        outcomes.append(solved)
        for position, frame in enumerate(frames):
            image = Image.fromarray(frame)
            last = position == len(frames) - 1
            text = f"episode {index + 1}" + (f": {'solved' if solved else 'failed'}" if last else "")
            ImageDraw.Draw(image).text((6, 4), text, fill=(255, 255, 255), stroke_width=1, stroke_fill=(0, 0, 0))
            images.append(image.quantize(128, dither=Image.Dither.NONE))
            durations.append(LAST_FRAME_MS if last else FRAME_MS)
    env.close()
    with replacing(path) as temporary, temporary.open("wb") as file:
        options: dict[str, Any] = {"duration": durations, "loop": 0, "optimize": True}
        images[0].save(file, "GIF", save_all=True, append_images=images[1:], **options)
    return outcomes
