"""
Proposition 1 on random tabular MDPs, where everything can be computed exactly.

The optimum of Eq. 9 is the root of a quadratic in C for each state and action, and the true discounted success probability
is a linear system: no sampling, no tolerance for noise. Solved exactly, the proposition needs more than a large beta: its
identity (Eq. 18) holds, but the step to Eq. 19 takes delta = beta C - p to be the same for all actions, which it is not.
What is true, and tested here:

- beta = 1 + p makes delta zero: the penalty cancels the density ratio of Eq. 7 exactly, and the bound holds with equality;
- a beta far above that breaks the bound, since the penalty's second half *raises* C on actions of the data;
- without that second half (``-E_D[C]``) the odds fall with beta, and the bound holds from some beta on.
"""

import numpy as np
import pytest
import torch as th

from sb3_offline.ceborl import losses

N_STATES, N_ACTIONS, GAMMA = 6, 3, 0.9
SEEDS = range(20)


def random_mdp(seed):
    rng = np.random.default_rng(seed)
    transitions = rng.dirichlet(np.full(N_STATES, 0.3), size=(N_STATES, N_ACTIONS))
    success = rng.uniform(size=N_STATES) * (rng.uniform(size=N_STATES) < 0.4)  # p(e | s)
    success[0] = 0.9
    behavior = rng.dirichlet(np.ones(N_ACTIONS), size=N_STATES)
    policy = rng.dirichlet(np.ones(N_ACTIONS), size=N_STATES)
    return transitions, success, behavior, policy


def future_success(transitions, success, policy):
    """p^pi(e_{t+} = 1 | s, a): Q with the reward (1 - gamma) p(e | s), exactly."""
    flow = np.einsum("ijk,kl->ijkl", transitions, policy).reshape(N_STATES * N_ACTIONS, -1)
    reward = np.repeat((1 - GAMMA) * success, N_ACTIONS)
    return np.linalg.solve(np.eye(len(flow)) - GAMMA * flow, reward).reshape(N_STATES, N_ACTIONS)


def optimal_classifier(positives, penalty):
    """
    Maximum over C of  n log C + log(1 - C) - k C:  the root in (0, 1) of  n (1 - C) - C - k C (1 - C),
    with n and k the weights of positives and penalty relative to the data's density.
    """
    n, k = positives, penalty
    return 2 * n / (n + 1 + k + np.sqrt((n + 1 + k) ** 2 - 4 * k * n))


def odds(classifier):
    return classifier / (1 - classifier)


def mean(policy, values):
    return np.einsum("sa,sa->s", policy, values)


@pytest.mark.parametrize("seed", SEEDS)
def test_eq_7_and_eq_18(seed):
    transitions, success, behavior, policy = random_mdp(seed)
    future, ratio = future_success(transitions, success, policy), policy / behavior
    np.testing.assert_allclose(odds(optimal_classifier(future * ratio, 0.0)), future * ratio, rtol=1e-9)
    for beta in (0.1, 1.0, 30.0):
        classifier = optimal_classifier(future * ratio, beta * (ratio - 1))
        delta = beta * classifier - future
        expected = mean(policy, future) - mean(policy, (ratio - 1) * delta)
        np.testing.assert_allclose(mean(policy, odds(classifier)), expected, rtol=1e-7)


@pytest.mark.parametrize("seed", SEEDS)
def test_bound_holds_where_the_penalty_cancels_the_density_ratio(seed):
    transitions, success, behavior, policy = random_mdp(seed)
    future, ratio = future_success(transitions, success, policy), policy / behavior
    beta = 1 + future  # = p / C, the smallest beta that the proposition allows
    classifier = optimal_classifier(future * ratio, beta * (ratio - 1))
    np.testing.assert_allclose(odds(classifier), future, rtol=1e-7)
    assert (mean(policy, odds(classifier)) <= mean(policy, future) * (1 + 1e-9)).all()
    assert (mean(policy, future * ratio) > mean(policy, future)).any()  # what it mends


@pytest.mark.parametrize("seed", SEEDS)
def test_a_large_beta_alone_breaks_the_bound(seed):
    transitions, success, behavior, policy = random_mdp(seed)
    future, ratio = future_success(transitions, success, policy), policy / behavior
    beta = 100.0
    classifier = optimal_classifier(future * ratio, beta * (ratio - 1))
    assert beta >= (future / classifier).max()  # the proposition's condition is met ...
    assert (mean(policy, odds(classifier)) > mean(policy, future)).any()  # ... and yet


@pytest.mark.parametrize("seed", SEEDS)
def test_bound_holds_without_the_data_half_of_the_penalty(seed):
    transitions, success, behavior, policy = random_mdp(seed)
    future, ratio = future_success(transitions, success, policy), policy / behavior
    gaps = []
    for beta in (0.0, 1.0, 10.0, 100.0):
        classifier = optimal_classifier(future * ratio, beta * ratio)
        gaps.append((mean(policy, odds(classifier)) - mean(policy, future)).max())
    assert (np.diff(gaps) < 0).all() and gaps[-1] <= 0


def test_library_losses_have_this_optimum():
    """At the closed form, the gradient of the library's own terms is zero; each cell of the table is a batch of one."""
    transitions, success, behavior, policy = random_mdp(3)
    future, ratio = future_success(transitions, success, policy), policy / behavior
    flow = np.einsum("ijk,kl->ijkl", transitions, policy)
    # Eq. 10 in expectation: positives are p(e | s) pi / pi_beta now, and omega later.
    now = (1 - GAMMA) * success[:, None] * ratio
    later = GAMMA * np.einsum("ijkl,kl->ij", flow, future)
    for beta in (0.0, 0.5):
        optimum = optimal_classifier(now + later, beta * (ratio - 1))
        logits = th.tensor(np.log(odds(optimum)), requires_grad=True)
        for s in range(N_STATES):
            for a in range(N_ACTIONS):
                cell = logits[s, a].view(1, 1)
                negatives = losses.recursive_loss(cell, th.tensor([later[s, a]]))
                positives = losses.example_loss(cell, GAMMA, class_prior=float(success[s] * ratio[s, a]))
                # mu = pi: the sampled action is this cell with weight pi / pi_beta, the data's with weight 1
                sampled = losses.conservative_penalty(cell.detach(), cell.unsqueeze(-1))
                data = losses.conservative_penalty(cell, cell.detach().unsqueeze(-1))
                (negatives + positives + beta * (ratio[s, a] * sampled + data)).backward()
        np.testing.assert_allclose(logits.grad, 0.0, atol=1e-9)
