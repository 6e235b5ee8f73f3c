"""Success labels from examples."""

import numpy as np
import pytest
import torch as th
from point_mass import ACTIONS, GOALS, RADIUS, STATES, goal_examples, write_point_mass

from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.errors import DatasetError
from sb3_offline.labelling.calibration import calibrate
from sb3_offline.labelling.classifier import ClassifierSettings, success_probabilities
from sb3_offline.labelling.losses import positive_unlabelled_loss

SETTINGS = ClassifierSettings(gradient_steps=150, batch_size=128)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("labelling") / "mixed.h5"
    write_point_mass(path, n_episodes=240)
    return path


@pytest.fixture(scope="module")
def buffer(data):
    return OfflineReplayBuffer(str(data), STATES, ACTIONS, "cpu")


@pytest.fixture(scope="module")
def probabilities(buffer):
    return success_probabilities(buffer, goal_examples(), SETTINGS)


def near_goal(observations):
    return np.linalg.norm(observations - GOALS[0], axis=-1) < RADIUS


def test_the_classifier_finds_the_observations_that_look_like_the_examples(buffer, probabilities):
    rows = np.asarray(buffer.datasets[0].observations)
    solved = near_goal(rows)
    assert probabilities.rows[solved].mean() > 0.8
    assert probabilities.rows[np.linalg.norm(rows - GOALS[0], axis=-1) > 2 * RADIUS].mean() < 0.02
    # The share of successes is estimated without a label
    assert probabilities.calibration.positive_share == pytest.approx(solved.mean(), rel=0.4)
    assert probabilities.rows.mean() == pytest.approx(probabilities.calibration.positive_share, rel=0.05)


def test_steps_have_the_observations_that_they_start_in_and_lead_to(buffer, probabilities):
    everything = buffer.transitions(np.arange(buffer.size()))
    rows = np.asarray(buffer.datasets[0].observations)
    at = {row.tobytes(): p for row, p in zip(rows, probabilities.rows, strict=True)}
    for given, observations in (
        (probabilities.before, everything.observations),
        (probabilities.after, everything.next_observations),
    ):
        assert given.shape == (buffer.size(),) and given.dtype == np.float32
        np.testing.assert_array_equal(given, [at[row.tobytes()] for row in observations.numpy()])


def test_labels_repeat_and_leave_global_random_numbers_alone(buffer, probabilities):
    th.manual_seed(3)
    wanted = th.rand(1)
    th.manual_seed(3)
    sampler = buffer.get_rng_state()
    again = success_probabilities(buffer, goal_examples(), SETTINGS)
    assert th.rand(1) == wanted and buffer.get_rng_state() == sampler
    np.testing.assert_array_equal(again.rows, probabilities.rows)
    assert not np.array_equal(success_probabilities(buffer, goal_examples(), SETTINGS, seed=1).rows, again.rows)


def test_too_few_examples_are_refused(buffer):
    with pytest.raises(DatasetError, match="examples: are 2, but the classifier needs 3"):
        success_probabilities(buffer, goal_examples(n=2), SETTINGS)


def test_the_loss_corrects_for_successes_among_the_data():
    rng = np.random.default_rng(0)
    examples, data = rng.normal(size=20), rng.normal(size=30)

    def loss(share):
        return float(positive_unlabelled_loss(th.as_tensor(examples), th.as_tensor(data), share))

    softplus = lambda x: np.log1p(np.exp(x)).mean()  # noqa: E731
    assert loss(0) == pytest.approx(softplus(-examples) + softplus(data))
    negatives = softplus(data) - 0.3 * softplus(examples)
    assert loss(0.3) == pytest.approx(softplus(-examples) + abs(negatives) / 0.7)


def test_probabilities_are_calibrated_without_labels():
    """The classes overlap, so that no threshold separates them; counts and probabilities hold nevertheless."""
    rng = np.random.default_rng(0)
    success = rng.random(20_000) < 0.1
    logits, examples = rng.normal(np.where(success, 2, -2), 1.0), rng.normal(2, 1.0, size=500)
    calibration = calibrate(examples, logits)
    probabilities = calibration(logits)
    assert calibration.positive_share == pytest.approx(0.1, abs=0.02)
    for low, high in ((0, 0.2), (0.2, 0.8), (0.8, 1)):
        inside = (probabilities >= low) & (probabilities <= high)
        assert probabilities[inside].mean() == pytest.approx(success[inside].mean(), abs=0.1)
