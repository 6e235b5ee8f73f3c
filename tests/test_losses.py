"""The loss terms against a plain NumPy float64 reading of the paper's Eq. 10."""

import numpy as np
import pytest
import torch as th

from sb3_offline.ceborl import losses


def sigmoid(logits):
    return 1 / (1 + np.exp(-logits))


def cross_entropy(probability, label):
    return -(label * np.log(probability) + (1 - label) * np.log(1 - probability))


@pytest.fixture
def logits():
    rng = np.random.default_rng(0)
    return {
        "data": rng.normal(scale=3, size=(2, 64)),
        "next": rng.normal(scale=3, size=(2, 64)),
        "examples": rng.normal(scale=3, size=(2, 32)),
        "sampled": rng.normal(scale=3, size=(2, 64, 16)),
    }


def tensor(array):
    return th.tensor(array, dtype=th.float32)


def test_omega_is_the_smallest_odds_of_the_critics(logits):
    odds = sigmoid(logits["next"]) / (1 - sigmoid(logits["next"]))
    omega = losses.success_odds(tensor(logits["next"]), omega_max=1e4)
    np.testing.assert_allclose(omega, odds.min(axis=0), rtol=1e-5)
    assert losses.success_odds(th.full((2, 3), 50.0), omega_max=1e4).tolist() == pytest.approx([1e4] * 3)


def test_term_a_penalty(logits):
    for space, squash in (("probability", sigmoid), ("logit", lambda f: f)):
        sampled = np.log(np.mean(np.exp(squash(logits["sampled"])), axis=-1))
        expected = (sampled - squash(logits["data"])).mean(axis=1).sum()
        got = losses.conservative_penalty(tensor(logits["data"]), tensor(logits["sampled"]), space)
        np.testing.assert_allclose(got, expected, rtol=1e-5)


def test_term_b_examples(logits):
    gamma, prior = 0.99, 0.3
    expected = (1 - gamma) * prior * cross_entropy(sigmoid(logits["examples"]), 1.0).mean(axis=1).sum()
    np.testing.assert_allclose(losses.example_loss(tensor(logits["examples"]), gamma, prior), expected, rtol=1e-5)


def test_term_c_recursive_classification(logits):
    gamma = 0.99
    omega = np.exp(logits["next"].min(axis=0))
    label = gamma * omega / (gamma * omega + 1)
    expected = ((1 + gamma * omega) * cross_entropy(sigmoid(logits["data"]), label)).mean(axis=1).sum()
    got = losses.recursive_loss(tensor(logits["data"]), tensor(gamma * omega))
    np.testing.assert_allclose(got, expected, rtol=1e-5)


def test_losses_are_finite_and_keep_gradients_for_saturated_logits():
    f = th.tensor([[-90.0, 0.0, 90.0]] * 2, requires_grad=True)
    omega = losses.success_odds(f.detach(), omega_max=1e4)
    loss = losses.recursive_loss(f, omega) + losses.example_loss(f, 0.99) + losses.conservative_penalty(f, f.unsqueeze(-1))
    loss.backward()
    assert th.isfinite(loss) and th.isfinite(f.grad).all()
