"""Verdicts on episodes: which of them solve the task that examples show, without any label."""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecTransposeImage

from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.example_gap import example_gap
from sb3_offline.data.examples import Observations, examples_checksum, load_examples
from sb3_offline.data.reader import DatasetLike, OfflineDataset, open_datasets
from sb3_offline.data.spaces import subspaces
from sb3_offline.data.storage import RowStore
from sb3_offline.labelling.calibration import Calibration, calibrate
from sb3_offline.labelling.classifier import ClassifierSettings, StepProbabilities, rows_after, success_probabilities

#: An episode is scored by its highest logits: this many
HIGHEST = 3
#: An episode is detected if its score, a probability, is at least this
THRESHOLD = 0.5
#: Number of resampled data of which an interval is computed, and the quantiles that it ends at
RESAMPLED, INTERVAL = 200, (0.05, 0.95)
BINS = 1000


class Estimate(NamedTuple):
    """
    A number that is estimated without labels, and the interval in which it lies nine times of ten if the examples look like
    the data's successes.
    """

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class EpisodeLabels:
    """
    Success labels of all episodes of some data.

    :param probabilities: (N,) float32, for each step the probability that the observation that it leads to shows success
    :param lengths: (E,) int64, steps of each episode
    :param ranking: (E,) float32, mean of the highest logits of each episode; orders episodes also where scores are all but 1
    :param scores: (E,) float32, ``ranking`` as a probability
    :param estimated_precision: share of true successes among the detected episodes
    :param estimated_successes: number of successful episodes
    :param checksum: identifies the data, see :func:`data_checksum`
    :param made_with: examples, settings and seed that the labels depend on, in JSON types
    :param warnings: doubts about the labels
    """

    probabilities: np.ndarray
    lengths: np.ndarray
    ranking: np.ndarray
    scores: np.ndarray
    estimated_precision: Estimate
    estimated_successes: Estimate
    checksum: int
    made_with: Mapping[str, Any] = field(default_factory=dict)
    warnings: Sequence[str] = ()

    @property
    def detected(self) -> np.ndarray:
        """(E,) bool, true for the episodes that are taken for successes."""
        return self.scores >= THRESHOLD

    @property
    def success(self) -> np.ndarray:
        """(N,) bool, a label for each step in place of the environment's: true where a detected episode shows success."""
        return (self.probabilities >= THRESHOLD) & np.repeat(self.detected, self.lengths)

    def best(self, n: int) -> np.ndarray:
        """
        :param n: a number of episodes
        :return: (E,) bool, true for the n episodes that look most like successes
        """
        chosen = np.zeros(len(self.lengths), dtype=bool)
        chosen[np.argsort(-self.ranking, kind="stable")[:n]] = True
        return chosen

    def check_data(self, datasets: Sequence[OfflineDataset], file: str | PathLike = "") -> None:
        """
        :param datasets: open datasets
        :param file: file of the labels, for the error
        :raises DatasetError: if the labels belong to other data
        """
        if data_checksum(datasets) != self.checksum:
            problem = f"hold {len(self.lengths)} episodes of other data than {datasets[0].path}"
            remedy = "Label these data (sb3-offline label), all of their files together and in the same order"
            raise DatasetError(file, "labels", problem, remedy)

    def rewards_of(self, buffer: OfflineReplayBuffer) -> np.ndarray:
        """
        :param buffer: the data that were labelled; raises ``DatasetError`` for others
        :return: (N,) float32, 1 for the steps that are labelled as successes, and 0 for all others
        """
        self.check_data(buffer.datasets)
        return self.success.astype(np.float32)


def label_episodes(
    dataset: DatasetLike,
    examples: str | PathLike | np.ndarray | Mapping[str, np.ndarray],
    *,
    settings: ClassifierSettings | None = None,
    seed: int = 0,
    device: th.device | str = "auto",
) -> EpisodeLabels:
    """
    Find the episodes that solve a task, of which only examples of success are known::

        labels = label_episodes("data.h5", "pictures_of_success/")
        labels.detected.sum(), labels.estimated_precision, labels.estimated_successes

    A classifier learns to tell the examples from the data (see
    :func:`~sb3_offline.labelling.classifier.success_probabilities`). An episode is scored by its three observations that look
    most like success. Success labels, rewards and sources that the files may hold are not looked at.

    :param dataset: path, glob pattern, ``OfflineDataset``, or a sequence of these
    :param examples: success examples in any form that learners take: a folder of images, an ``.npz`` or HDF5 file, or arrays
    :param settings: how the classifier is trained
    :param seed: seed of the classifier
    :param device: device to compute on
    :return: the labels
    :raises DatasetError: if the examples do not fit the data
    """
    settings = settings or ClassifierSettings()
    datasets = open_datasets(dataset)
    space = _learner_space(datasets[0].observation_space)
    buffer = OfflineReplayBuffer(datasets, space, datasets[0].action_space, get_device(device))
    stored = load_examples(examples, datasets[0].observation_space)  # as the files hold them
    steps = success_probabilities(buffer, load_examples(stored, space), settings, seed=seed)
    options = {**settings._asdict(), "net_arch": [*settings.net_arch]}
    ranking = episode_logits(steps)
    scores = steps.calibration(ranking)
    precision, successes = estimate(steps, ranking)
    return EpisodeLabels(
        probabilities=steps.after,
        lengths=steps.lengths,
        ranking=ranking,
        scores=scores,
        estimated_precision=precision,
        estimated_successes=successes,
        checksum=data_checksum(datasets),
        made_with={"examples_checksum": examples_checksum(stored), "seed": seed, **options},
        warnings=_doubts(datasets, stored, scores),
    )


def data_checksum(datasets: Sequence[OfflineDataset]) -> int:
    """
    :param datasets: open datasets
    :return: a checksum of all actions and lengths. It stays the same where the observations of the same episodes are drawn
        again, with another camera, since their labels hold for these, too
    """
    checksum = 0
    for part in datasets:
        checksum = zlib.crc32(np.ascontiguousarray(part.actions).data, zlib.crc32(part.lengths.astype("<i8").data, checksum))
    return checksum


def episode_logits(steps: StepProbabilities) -> np.ndarray:
    """
    :param steps: logits of all observations
    :return: (E,) float32, for each episode the mean of its three highest logits, apart from that of its first observation
    """
    logits, ends = steps.logits[rows_after(steps.lengths)], np.cumsum(steps.lengths)
    highest = (np.sort(part)[-HIGHEST:] for part in np.split(logits, ends[:-1]))
    return np.array([part.mean() for part in highest], np.float32)


def estimate(steps: StepProbabilities, ranking: np.ndarray, seed: int = 0) -> tuple[Estimate, Estimate]:
    """
    Estimate the precision of the detected episodes and the number of successful ones from their calibrated scores. The
    interval is that of a bootstrap: episodes and examples are drawn with replacement, and the calibration is repeated.

    :param steps: logits of all observations, and of the examples
    :param ranking: from :func:`episode_logits`
    :param seed: seed of the draws
    :return: precision, and number of successful episodes
    """
    rng = np.random.default_rng(seed)
    detected = steps.calibration(ranking) >= THRESHOLD
    edges = np.linspace(steps.logits.min(), steps.logits.max() + 1e-6, BINS + 1)  # bins, since there are many observations
    bin_of_row, centres = np.digitize(steps.logits, edges[1:-1]), (edges[:-1] + edges[1:]) / 2
    n_examples, n_episodes = len(steps.example_logits), len(steps.lengths)

    def judge(calibration: Calibration, weights: np.ndarray) -> tuple[float, float]:
        scores = calibration(ranking)
        found = (weights * detected).sum()
        return (weights * detected * scores).sum() / max(found, 1), (weights * scores).sum()

    best = judge(steps.calibration, np.ones(n_episodes))
    draws = []
    for _ in range(RESAMPLED):
        examples = steps.example_logits[rng.integers(n_examples, size=n_examples)]
        weights = np.bincount(rng.integers(n_episodes, size=n_episodes), minlength=n_episodes).astype(float)
        counts = np.bincount(bin_of_row, np.repeat(weights, steps.lengths + 1), BINS)
        draws.append(judge(calibrate(examples, centres, counts), weights))
    low, high = np.quantile(draws, INTERVAL, axis=0)
    precision, successes = (
        Estimate(float(best[i]), float(min(low[i], best[i])), float(max(high[i], best[i]))) for i in range(2)
    )
    return precision, successes


def _doubts(datasets: Sequence[OfflineDataset], examples: Observations, scores: np.ndarray) -> list[str]:
    """:return: reasons to look at the labels before they are used"""
    space = datasets[0].observation_space
    names = subspaces(space, "observations")
    stores = {name: RowStore([part.arrays[name] for part in datasets]) for name in names}
    gap = example_gap(space, stores, np.concatenate([part.lengths for part in datasets]), examples)
    doubts = [] if (found := gap.problem()) is None else [f"examples: {found[0]}. {found[1]}"]
    if not (scores >= THRESHOLD).any():
        doubts.append("No episode is detected. The data may hold no success, or the examples may not look like the data's")
    return doubts


def _learner_space(space: spaces.Space) -> spaces.Space:
    """:return: the space with its images channel-first, as learners see it"""
    if isinstance(space, spaces.Dict):
        return spaces.Dict({key: _learner_space(part) for key, part in space.spaces.items()})
    if isinstance(space, spaces.Box) and is_image_space(space) and not is_image_space_channels_first(space):
        return VecTransposeImage.transpose_space(space)
    return space


class LabelCheck(NamedTuple):
    """
    Labels compared with the truth, where it is known.

    :param auc: probability that a success ranks above a failure; nan if one of them is missing
    :param precision: share of true successes among the detected episodes; nan if none is detected
    :param recall: share of detected episodes among the true successes; nan if there are none
    :param successes: number of true successes
    """

    auc: float
    precision: float
    recall: float
    successes: int


def check_labels(labels: EpisodeLabels, solved: np.ndarray) -> LabelCheck:
    """
    :param labels: labels of some data
    :param solved: (E,) bool, the truth about each episode
    :return: how far they agree
    """
    _, rank, counts = np.unique(labels.ranking, return_inverse=True, return_counts=True)
    mean_rank = np.cumsum(counts) - (counts - 1) / 2
    n, failures, detected = int(solved.sum()), int((~solved).sum()), labels.detected
    wins = mean_rank[rank][solved].sum() - n * (n + 1) / 2
    return LabelCheck(
        auc=float(wins / (n * failures)) if n and failures else float("nan"),
        precision=float(solved[detected].mean()) if detected.any() else float("nan"),
        recall=float(detected[solved].mean()) if n else float("nan"),
        successes=n,
    )


def solved_episodes(datasets: Sequence[OfflineDataset], array: str = "success") -> np.ndarray:
    """
    :param datasets: open datasets
    :param array: name of labels of steps, ``success`` or an array such as ``extras/task_success``; of several columns, one is
        chosen as in ``extras/task_success:2``
    :return: (E,) bool, true for the episodes with such a step
    :raises DatasetError: if there are no such labels
    """
    name, _, column = array.partition(":")
    solved = []
    for part in datasets:
        found = part.arrays.get(name)
        if found is None or (len(found.shape) > 1) != column.isdigit() or (column and int(column) >= found.shape[1]):
            shape = "is missing" if found is None else f"has rows of shape {found.shape[1:]}"
            remedy = "Name labels of steps that the file has, as in success or extras/task_success:2"
            raise DatasetError(part.path, array, shape, remedy)
        steps = np.asarray(found[:], dtype=bool)
        solved.append(np.logical_or.reduceat(steps[:, int(column)] if column else steps, part.step_starts))
    return np.concatenate(solved)
