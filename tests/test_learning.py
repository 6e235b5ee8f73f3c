"""Do they learn? On a point mass whose data head for four goals alike, told of one goal by examples."""

import pytest
from point_mass import goal_examples, write_point_mass

from sb3_offline import BC, CEBORL
from sb3_offline.experiment.evaluation import evaluate_success

SMALL = {"net_arch": [64, 64]}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    path = tmp_path_factory.mktemp("point") / "point_mass.h5"
    write_point_mass(path)
    return str(path)


@pytest.mark.parametrize("goal", [0, 3])
def test_ceborl_reaches_the_goal_of_its_examples(dataset, goal):
    examples = goal_examples(goal=goal)
    model = CEBORL("MlpPolicy", "TestPointMass-v0", dataset, examples, n_action_samples=4, seed=0, policy_kwargs=SMALL)
    model.learn(600)
    assert evaluate_success(model, "TestPointMass-v0", {"goal": goal}, 20).success_rate >= 0.9


def test_bc_does_not_know_which_goal(dataset):
    model = BC("MlpPolicy", "TestPointMass-v0", dataset, seed=0, policy_kwargs=SMALL).learn(600)
    rates = [evaluate_success(model, "TestPointMass-v0", {"goal": goal}, 20).success_rate for goal in range(4)]
    assert sum(rates) <= 1.0 + 1e-9
