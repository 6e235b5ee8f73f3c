"""Values of a trained classifier along recorded trajectories."""

from dataclasses import dataclass

import numpy as np
import torch as th

from sb3_offline.ceborl.classifier import RecursiveClassifier
from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.reader import OfflineDataset


@dataclass(frozen=True)
class JudgedTrajectories:
    """
    Recorded trajectories and the odds of a classifier along them.

    :param odds: ``(episodes, decisions)``, C / (1 - C) of each recorded state and action, from the lower critic
    :param success: ``(episodes, decisions)`` bool, success after each decision
    :param scene_state: ``(episodes, decisions, 30)``, state of the scene after each decision, to draw it
    :param seeds: ``(episodes,)``, seed of each episode, to draw the scene before the first decision
    """

    odds: np.ndarray
    success: np.ndarray
    scene_state: np.ndarray
    seeds: np.ndarray

    @property
    def solved(self) -> np.ndarray:
        """``(episodes,)`` bool, success after some decision."""
        return np.asarray(self.success.any(axis=1))


@th.no_grad()
def judge_trajectories(model: RecursiveClassifier, dataset: OfflineDataset) -> JudgedTrajectories:
    """
    :param model: the model whose critics are the classifier
    :param dataset: labelled episodes of equal length, with the extra ``scene_state``
    :return: the trajectories with the odds of every decision
    """
    buffer = OfflineReplayBuffer(
        dataset, model.observation_space, model.action_space, device=model.device, n_stack=model.n_stack
    )
    batches = []
    for indices in np.array_split(np.arange(buffer.size()), max(buffer.size() // 512, 1)):
        samples = buffer.transitions(indices)
        logits = model.critic.values(model.critic.encode(samples.observations), samples.actions)
        batches.append(logits.amin(dim=0).exp().cpu().numpy())
    shape = (dataset.n_episodes, int(dataset.lengths[0]))
    assert dataset.success is not None and dataset.seeds is not None
    return JudgedTrajectories(
        np.concatenate(batches).reshape(shape),
        np.asarray(dataset.success).reshape(shape),
        np.asarray(dataset.extras["scene_state"]).reshape(*shape, -1),
        np.asarray(dataset.seeds),
    )


def pick_trajectories(judged: JudgedTrajectories) -> tuple[int, int]:
    """
    :param judged: all trajectories
    :return: indices of the first one that succeeds and the first one that fails
    """
    return int(np.argmax(judged.solved)), int(np.argmin(judged.solved))
