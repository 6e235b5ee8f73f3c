"""Each warning, in a run that deserves it; and none in one that does not."""

import warnings

import numpy as np
import pytest
import torch as th
from point_mass import goal_examples, write_point_mass
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_offline import BC, CEBORL
from sb3_offline.ceborl import PAPER_FORM, DiagnosticsCallback
from sb3_offline.ceborl.extraction import WeightedRegression

#: The 1-step odds, a target that follows the critic closely, large steps, no penalty: values run away within seconds
RUNS_AWAY = {**PAPER_FORM, "n_steps": 1, "tau": 0.05, "beta": 0.0, "learning_rate": 3e-3}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    path = tmp_path_factory.mktemp("point") / "point_mass.h5"
    write_point_mass(path)
    return str(path)


def learn(dataset, steps, callback=None, examples=None, **kwargs):
    """:return: the model, and what it was warned of"""
    small = {"policy_kwargs": {"net_arch": [64, 64]}, "n_action_samples": 4, "batch_size": 128, "seed": 0, **kwargs}
    model = CEBORL("MlpPolicy", None, dataset, goal_examples() if examples is None else examples, **small)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(steps, callback)
    return model, [str(warning.message) for warning in caught]


def test_a_run_that_learns_is_not_warned_of_and_stays_the_same(dataset):
    watched, messages = learn(dataset, 150, DiagnosticsCallback(check_freq=50))
    assert messages == []
    alone, _ = learn(dataset, 150)
    for name, value in watched.policy.state_dict().items():
        assert th.equal(value, alone.policy.state_dict()[name]), name


def test_values_that_run_away_are_told_once_each_with_a_remedy(dataset):
    _, messages = learn(dataset, 550, DiagnosticsCallback(check_freq=50), **RUNS_AWAY)
    for symptom, remedy in {
        "of the data: the classifier takes most of it for success": "example_share=0.02",
        "at their bound of 10000 for": "see there",
        "sits on the bounds": "policy_extraction='weighted'",
    }.items():
        assert [remedy in message for message in messages if symptom in message] == [True], symptom
    assert len(messages) == 3 and all(message.startswith("Step ") for message in messages)


def test_a_domain_gap_is_told(dataset):
    far = goal_examples() + np.float32(1.0)
    _, messages = learn(dataset, 50, DiagnosticsCallback(check_freq=50), far, backup="dataset")
    assert len(messages) == 1 and "tells all examples from each of 1024 states" in messages[0]
    _, messages = learn(dataset, 50, DiagnosticsCallback(check_freq=50, early_steps=40), far, backup="dataset")
    assert messages == []  # late, it may know them by heart


def test_weights_that_are_too_sharp_are_told(dataset, monkeypatch):
    monkeypatch.setattr(WeightedRegression, "weight_max", 1e17)
    _, messages = learn(dataset, 100, DiagnosticsCallback(check_freq=20), temperature=0.005, backup="dataset")
    assert len(messages) == 1 and "Raise temperature (now 0.005)" in messages[0]


def test_what_is_measured_is_logged(dataset, tmp_path):
    learn(dataset, 4, DiagnosticsCallback(check_freq=2), tensorboard_log=str(tmp_path))
    (folder,) = tmp_path.iterdir()
    events = EventAccumulator(str(folder)).Reload()
    for name in ("classifier_saturated", "data_like_examples"):
        assert [event.step for event in events.Scalars(f"diagnostics/{name}")] == [2, 4]


def test_other_algorithms_are_refused(dataset):
    with pytest.raises(TypeError, match="for CEBORL and RCE, not for BC"):
        BC("MlpPolicy", None, dataset).learn(1, DiagnosticsCallback())
