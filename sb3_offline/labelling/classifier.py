"""A classifier of success from examples: the probability that an observation of the data shows the solved task."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch.nn import functional as F

from sb3_offline.common.augmentation import has_images, shift_observations
from sb3_offline.common.choices import CountingFromZero
from sb3_offline.common.fast import encode, mlp
from sb3_offline.common.policies import stored_features
from sb3_offline.common.torch_layers import (
    NormalizedNatureCNN,
    StandardizedCombinedExtractor,
    StandardizedExtractor,
    fit_statistics,
)
from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import Observations, example_columns
from sb3_offline.labelling.calibration import Calibration, calibrate

#: Makes a new, untrained encoder of observations, e.g. ``policy.make_features_extractor``
EncoderFactory = Callable[[], BaseFeaturesExtractor]

SCORED_AT_ONCE = 512
#: Every so many gradient steps, so many observations are scored, and so many of the highest are the hard ones from then on
HARD_EVERY, HARD_SCORED, HARD_KEPT = 50, 4096, 512
VECTOR_STEPS, IMAGE_STEPS = 300, 200


class ClassifierSettings(NamedTuple):
    """
    How the classifier is trained. The defaults were chosen on the second table of tasks.

    :param n_models: networks, each trained without one share of the episodes and of the examples, which it then judges
    :param gradient_steps: gradient steps of each; ``None`` for 300 from vectors and 200 from images
    :param batch_size: observations of the data in a batch
    :param example_batch_size: examples in a batch; both classes weigh the same
    :param hard_share: share of the observations in a batch that are drawn from those that look most like success so far,
        which are successes and near misses; 0 draws all uniformly
    :param learning_rate: learning rate
    :param weight_decay: L2 penalty
    :param net_arch: hidden layers on top of the encoder
    :param max_shift: largest random shift of images in pixels
    """

    n_models: int = 3
    gradient_steps: int | None = None
    batch_size: int = 256
    example_batch_size: int = 64
    hard_share: float = 0.5
    learning_rate: float = 3e-4
    weight_decay: float = 1e-2
    net_arch: tuple[int, ...] = (256, 256)
    max_shift: int = 4


class StepProbabilities(NamedTuple):
    """
    The probability of success of every observation of some data.

    :param rows: (N + E,) float32, of each observation: episode e of n steps has n + 1 of them, one after the other
    :param lengths: (E,) int64, steps of each episode
    :param calibration: how logits became probabilities
    :param logits: (N + E,) float32, of each observation, from a network that did not learn from its episode
    :param example_logits: (n,) float32, of each example, from a network that did not learn from it
    """

    rows: np.ndarray
    lengths: np.ndarray
    calibration: Calibration
    logits: np.ndarray
    example_logits: np.ndarray

    @property
    def before(self) -> np.ndarray:
        """(N,) float32, for each step the probability of the observation that it starts in."""
        return np.delete(self.rows, np.cumsum(self.lengths + 1) - 1)

    @property
    def after(self) -> np.ndarray:
        """
        (N,) float32, for each step the probability of the observation that it leads to. Success labels of environments are
        of this observation, so it decides about episodes and gives rewards.
        """
        return self.rows[rows_after(self.lengths)]


def rows_after(lengths: np.ndarray) -> np.ndarray:
    """
    :param lengths: (E,) steps of each episode
    :return: (N,) int64, for each step the row of the observation that it leads to
    """
    return np.delete(np.arange(lengths.sum() + len(lengths)), np.cumsum(lengths + 1) - lengths - 1)


class StateClassifier(CountingFromZero):
    """
    A network that tells success examples from the observations of a dataset. It has its own encoder and sees no action.

    :param observation_space: Observation space, images channel-first
    :param action_space: Action space
    :param features_extractor: encoder of the observations
    :param net_arch: hidden layers on top of it
    :param kwargs: see :class:`stable_baselines3.common.policies.BaseModel`
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        features_extractor: BaseFeaturesExtractor,
        net_arch: list[int],
        **kwargs: Any,
    ):
        super().__init__(observation_space, action_space, features_extractor=features_extractor, **kwargs)
        self.head = nn.Sequential(*create_mlp(features_extractor.features_dim, 1, net_arch))

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """
        :param observations: uint8 images channel-first or float vectors (or a dict of them), batch first
        :return: logits, ``(batch,)``
        """
        return mlp(self.head, encode(partial(stored_features, self), observations, None)).squeeze(1)


def success_probabilities(
    buffer: OfflineReplayBuffer,
    examples: Observations,
    settings: ClassifierSettings | None = None,
    *,
    make_encoder: EncoderFactory | None = None,
    seed: int = 0,
) -> StepProbabilities:
    """
    Train classifiers to tell success examples from the data, and compute the probability of success of all observations.

    - Half of the observations that a network learns from are those that look most like success so far, so that it learns to
      tell successes from near misses.
    - No observation is judged by a network that was trained on its episode: each of ``n_models`` networks leaves out one share
      of the episodes and of the examples, and judges these.
    - What the networks say of what they did not see becomes a probability. The data are not taken for failures in this: they
      are unlabelled, and the share of successes among them is estimated, see
      :func:`~sb3_offline.labelling.calibration.calibrate`.

    Global random numbers stay as they are.

    :param buffer: the data, on the device to compute on. Its observations are read as the files hold them
    :param examples: ``(n, *observation)`` in the buffer's space (images channel-first), or a dict of these; from
        :func:`~sb3_offline.data.examples.load_examples`. Keys that a dict lacks are not looked at in the data either
    :param settings: how to train (default: ``ClassifierSettings()``)
    :param make_encoder: makes a new encoder of observations (default: that of our ``MlpPolicy``, ``CnnPolicy`` or
        ``MultiInputPolicy``, by the space)
    :param seed: seed of networks, folds and batches
    :return: the probabilities; the same ones for the same arguments on one device
    :raises DatasetError: if there are fewer examples or episodes than networks
    """
    settings = settings or ClassifierSettings()
    lengths, arrays, space = buffer.lengths, example_columns(examples), buffer.observation_space
    if isinstance(space, spaces.Dict):
        space = spaces.Dict({key: space[key] for key in space if key in arrays})
    n_examples = len(next(iter(arrays.values())))
    k = settings.n_models
    for field, n in (("episodes", len(lengths)), ("examples", n_examples)):
        if n < k:
            problem = f"are {n}, but the classifier needs {k} at least, to be judged on those that it has not seen"
            raise DatasetError(buffer.datasets[0].path, field, problem, f"Give more {field}")
    rng, source = np.random.default_rng(seed), _Observations(buffer, space, arrays)
    fold_of_row = np.repeat(_folds(len(lengths), k, rng), lengths + 1)
    fold_of_example = _folds(n_examples, k, rng)
    row_logits, example_logits = (np.empty(n, np.float32) for n in (len(fold_of_row), n_examples))
    for fold in range(k):
        unseen_rows, unseen_examples = (np.flatnonzero(of == fold) for of in (fold_of_row, fold_of_example))
        seen_rows, seen_examples = (np.flatnonzero(of != fold) for of in (fold_of_row, fold_of_example))
        if k == 1:
            seen_rows, seen_examples = unseen_rows, unseen_examples
        model = _train(source, seen_rows, seen_examples, settings, make_encoder, rng)
        row_logits[unseen_rows] = _logits(model, source.data, unseen_rows)
        example_logits[unseen_examples] = _logits(model, source.examples, unseen_examples)
    calibration = calibrate(example_logits, row_logits)
    return StepProbabilities(calibration(row_logits), lengths, calibration, row_logits, example_logits)


def _folds(n: int, k: int, rng: np.random.Generator) -> np.ndarray:
    """:return: (n,) the share of each of n things, all of nearly equal size"""
    return rng.permutation(np.arange(n) % k)


class _Observations(NamedTuple):
    """
    Where batches come from.

    :param buffer: the data
    :param space: the buffer's space, or of a Dict only the keys that the examples have
    :param arrays: the examples by key ("" without a dict)
    """

    buffer: OfflineReplayBuffer
    space: spaces.Space
    arrays: dict[str, np.ndarray]

    def data(self, rows: np.ndarray) -> PyTorchObs:
        """:return: these observations of the data"""
        batch = self.buffer.observations_at(rows)
        return {key: batch[key] for key in self.space} if isinstance(self.space, spaces.Dict) else batch  # type: ignore

    def examples(self, rows: np.ndarray) -> PyTorchObs:
        """:return: these examples"""
        batch = {key: th.as_tensor(array[rows], device=self.buffer.device) for key, array in self.arrays.items()}
        return batch if isinstance(self.space, spaces.Dict) else batch[""]


def _train(
    source: _Observations,
    rows: np.ndarray,
    example_rows: np.ndarray,
    settings: ClassifierSettings,
    make_encoder: EncoderFactory | None,
    rng: np.random.Generator,
) -> StateClassifier:
    """:return: a classifier, trained on these rows of the data and of the examples"""
    buffer, space = source.buffer, source.space
    gradient_steps = settings.gradient_steps or (IMAGE_STEPS if has_images(space) else VECTOR_STEPS)
    with th.random.fork_rng(devices=[buffer.device] if buffer.device.type == "cuda" else []):
        th.manual_seed(int(rng.integers(2**31)))
        encoder = make_encoder() if make_encoder is not None else _default_encoder(space)
        model = StateClassifier(space, buffer.action_space, encoder, list(settings.net_arch)).to(buffer.device)
    fit_statistics(model, buffer.observation_statistics)
    model.set_training_mode(True)
    optimizer = th.optim.Adam(model.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay, fused=True)
    hard, n_hard = rows, round(settings.hard_share * settings.batch_size)
    with th.enable_grad():
        for step in range(gradient_steps):
            if n_hard and step and step % HARD_EVERY == 0:
                hard = _hard_rows(model, source, rng.choice(rows, min(HARD_SCORED, len(rows)), replace=False))
            drawn = np.concatenate([rng.choice(hard, n_hard), rng.choice(rows, settings.batch_size - n_hard)])
            data = source.data(drawn)
            shown = source.examples(rng.choice(example_rows, settings.example_batch_size))
            data, shown = (shift_observations(batch, space, settings.max_shift, rng) for batch in (data, shown))
            loss = F.softplus(-model(shown)).mean() + F.softplus(model(data)).mean()  # cross-entropy, of both classes alike
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
    model.set_training_mode(False)
    return model


def _hard_rows(model: StateClassifier, source: _Observations, rows: np.ndarray) -> np.ndarray:
    """:return: those of these rows of the data that look most like success, an eighth"""
    model.set_training_mode(False)
    highest = np.argsort(-_logits(model, source.data, rows), kind="stable")[: len(rows) * HARD_KEPT // HARD_SCORED]
    model.set_training_mode(True)
    return rows[highest]


def _default_encoder(space: spaces.Space) -> BaseFeaturesExtractor:
    if isinstance(space, spaces.Dict):
        return StandardizedCombinedExtractor(space)
    return NormalizedNatureCNN(space) if is_image_space(space) else StandardizedExtractor(space)  # type: ignore[arg-type]


@th.no_grad()
def _logits(model: StateClassifier, read: Callable[[np.ndarray], PyTorchObs], rows: np.ndarray) -> np.ndarray:
    """:return: (n,) float32, the logits of these observations"""
    pieces = [rows[first : first + SCORED_AT_ONCE] for first in range(0, len(rows), SCORED_AT_ONCE)]
    return np.concatenate([model(read(piece)).float().cpu().numpy() for piece in pieces])
