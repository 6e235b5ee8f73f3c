"""Play episodes of the final policies, with the values of their critics."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_offline.benchmark.grid import cell_folder, evaluation_seed
from sb3_offline.common.offline_algorithm import OfflineAlgorithm
from sb3_offline.experiment.recording import make_recording_env, record_episode
from sb3_offline.experiment.training import load_run
from sb3_offline.report.results import Results

RECORDED_SIZE = 160
"""Width and height of the frames in pixels."""


@dataclass(frozen=True)
class PlayedEpisode:
    """
    One episode of a policy.

    :param frames: uint8 images, before the first decision and after each
    :param solved_at: index of the decision that solved the task, or ``None``
    :param values: value of each decision; empty if the method has no critic
    :param value_name: name of these values
    """

    frames: list[np.ndarray]
    solved_at: int | None
    values: list[float]
    value_name: str

    @property
    def solved(self) -> bool:
        """True if the task was solved."""
        return self.solved_at is not None


class _Watched:
    """Plays like a model, and keeps the value of each state and action: the lowest of its critics."""

    def __init__(self, model: OfflineAlgorithm):
        self.model, self.n_stack = model, model.n_stack
        self.values: list[float] = []
        self._normalizer = model.observation_normalizer()

    @th.no_grad()
    def predict(self, observation: Any, *args: Any, **kwargs: Any) -> Any:
        if self._normalizer is not None:
            observation = self._normalizer.normalize_obs(observation)
        action, state = self.model.predict(observation, *args, **kwargs)
        if self.model.value_name is not None:
            tensors, _ = self.model.policy.obs_to_tensor(observation)
            scaled = th.as_tensor(self.model.policy.scale_action(action)[None], device=self.model.device)
            self.values.append(float(self.model.values(tensors, scaled)))  # type: ignore[arg-type]
        return action, state


def play_finals(results: Results, runs: Path, *, trust: bool = False) -> Iterator[tuple[str, str, PlayedEpisode]]:
    """
    Play the first evaluation episode, unselected, of the last checkpoint and the first seed, for each method and task.

    :param results: results of a grid
    :param runs: folder of its runs
    :param trust: open models that may run any code
    :return: method, task and episode, as far as the runs exist
    """
    for (method, task), entry in results.entries.items():
        seed = min(entry.by("seed"))
        model_file = cell_folder(runs, method, task, seed) / "model.zip"
        if model_file.is_file():
            model, config = load_run(model_file, trust=trust)
            if ":" in str(config["env"]) and not trust:
                remedy = "if you trust the origin of the runs, add --trust"
                raise RuntimeError(f"{model_file}: its environment {config['env']!r} runs a module; {remedy}")
            env_kwargs = {**config["env_kwargs"], "task": task}
            yield method, task, play(model, config["env"], env_kwargs, evaluation_seed(seed, len(entry.by("step")) - 1))


def play(model: OfflineAlgorithm, env_id: str, env_kwargs: dict[str, Any], seed: int) -> PlayedEpisode:
    """
    Play one episode with the mode of a policy.

    :param model: the model
    :param env_id: registered id of the environment
    :param env_kwargs: keyword arguments of the environment
    :param seed: seed of the episode
    :return: the episode
    """
    env = make_recording_env(env_id, env_kwargs, RECORDED_SIZE)
    watched = _Watched(model)
    try:
        frames, solved_at = record_episode(watched, env, seed)
    finally:
        env.close()
    return PlayedEpisode(frames, solved_at, watched.values, model.value_name or "")
