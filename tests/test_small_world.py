"""Where values go in a world whose truth is known: what docs/small_world.md says of the bound, on the terms of the library."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).resolve().parent.parent / "benchmarks"))

import small_world as sw

WORLD = sw.make_world()


def solve(variant):
    solution = sw.solve(WORLD, variant, n_iterations=500, policy_rate=0.05)
    assert solution.residual < 1e-4
    return solution.mean(solution.odds), solution.mean(solution.truth)


def test_the_world_is_what_it_says():
    np.testing.assert_allclose(WORLD.transitions.sum(axis=2), 1.0)
    np.testing.assert_allclose(WORLD.data.sum(), 1.0)
    policy = WORLD.modes[1]
    chain = np.einsum("sa,sax->sx", policy, WORLD.transitions)
    visits = sum((1 - sw.GAMMA) * sw.GAMMA**t * np.linalg.matrix_power(chain, t) for t in range(400))
    np.testing.assert_allclose((policy * WORLD.future_success(policy)).sum(axis=1), visits @ WORLD.success, atol=1e-12)


def test_without_penalty_the_odds_are_those_of_a_linear_system():
    """The policy's actions in (b) reward success by pi / pi_beta; the rest is a plain evaluation of the policy."""
    policy = WORLD.modes[1]
    variant = sw.Variant("", beta=0.0, class_prior=WORLD.class_share, fixed_policy=policy)
    ratio = np.divide(policy, WORLD.behavior, out=np.zeros_like(policy), where=WORLD.behavior > 0)
    reward = ((1 - sw.GAMMA) * WORLD.success[:, None] * ratio).reshape(-1)
    step = np.einsum("sax,xb->saxb", WORLD.transitions, policy).reshape(len(reward), -1)
    expected = np.linalg.solve(np.eye(len(reward)) - sw.GAMMA * step, reward).reshape(ratio.shape)
    seen = WORLD.data > 0
    np.testing.assert_allclose(sw.solve(WORLD, variant, 500).odds[seen], expected[seen], rtol=1e-6)


@pytest.mark.parametrize("changes", [{}, {"beta": 0.0}, {"n_steps": 1}])
def test_bound_holds_for_the_shipped_form_and_its_policy_is_better_than_the_data(changes):
    learned, true = solve(replace(sw.IN_SAMPLE, **changes))
    assert (learned <= true * (1 + 1e-6)).all()
    behavior = (WORLD.behavior * WORLD.future_success(WORLD.behavior)).sum(axis=1)
    assert true[sw.START] > 3 * behavior[sw.START]


@pytest.mark.parametrize(
    "variant",
    [sw.Variant("RCE", beta=0.0), sw.Variant("paper"), replace(sw.IN_SAMPLE, beta=10.0)],
    ids=["RCE", "paper", "default, beta = 10"],
)
def test_bound_is_broken_where_the_page_says_so(variant):
    learned, true = solve(variant)
    assert (learned > 1.1 * true).any()
