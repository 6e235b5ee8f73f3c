"""Final policies at play, and what their critics make of it."""

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

PICTURE_SIZE = 160


@dataclass(frozen=True)
class PlayedEpisode:
    """
    :param frames: uint8, before the first decision and after each
    :param solved_at: the decision that solved the task, if one did
    :param values: of each decision; none where the method has no critic
    :param value_name: what these are
    """

    frames: list[np.ndarray]
    solved_at: int | None
    values: list[float]
    value_name: str

    @property
    def solved(self) -> bool:
        return self.solved_at is not None


class _Watched:
    """Plays like a model, and keeps what its critics make of each state and action: the lowest of them."""

    def __init__(self, model: OfflineAlgorithm):
        self.model = model
        self.values: list[float] = []

    @th.no_grad()
    def predict(self, observation: Any, *args: Any, **kwargs: Any) -> Any:
        action, state = self.model.predict(observation, *args, **kwargs)
        if self.model.value_name is not None:
            tensors, _ = self.model.policy.obs_to_tensor(observation)
            scaled = th.as_tensor(self.model.policy.scale_action(action)[None], device=self.model.device)
            self.values.append(float(self.model.values(tensors, scaled)))  # type: ignore[arg-type]
        return action, state


def play_finals(results: Results, runs: Path) -> Iterator[tuple[str, str, PlayedEpisode]]:
    """
    The first evaluation episode of the last checkpoint, of each method and task, whatever comes of it; of the first seed.

    :param results: of the runs
    :param runs: their folder
    :return: method, task and episode; of the runs that are there
    """
    for (method, task), cell in results.cells.items():
        seed = min(cell.by("seed"))
        model_file = cell_folder(runs, method, task, seed) / "model.zip"
        if model_file.is_file():
            model, config = load_run(model_file)
            env_kwargs = {**config["env_kwargs"], "task": task}
            yield method, task, play(model, config["env"], env_kwargs, evaluation_seed(seed, len(cell.by("step")) - 1))


def play(model: OfflineAlgorithm, env_id: str, env_kwargs: dict[str, Any], seed: int) -> PlayedEpisode:
    """
    :param model: plays its mode
    :param env_id: registered id
    :param env_kwargs: of the environment
    :param seed: of the episode
    :return: what came of it
    """
    env = make_recording_env(env_id, env_kwargs, PICTURE_SIZE)
    watched = _Watched(model)
    try:
        frames, solved_at = record_episode(watched, env, seed)
    finally:
        env.close()
    return PlayedEpisode(frames, solved_at, watched.values, model.value_name or "")
