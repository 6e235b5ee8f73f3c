"""Success labels from examples."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from point_mass import ACTIONS, GOALS, RADIUS, STATES, goal_examples, write_point_mass

from sb3_offline import CQL
from sb3_offline.cli import main
from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.selection import select_episodes
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.data_tools.inspecting.joined_datasets import JoinedDatasets
from sb3_offline.data_tools.inspecting.label_page import write_label_page
from sb3_offline.experiment.training import create_model
from sb3_offline.labelling import (
    ClassifierSettings,
    EpisodeLabels,
    Estimate,
    check_labels,
    label_episodes,
    load_labels,
    save_labels,
    select_detected,
    success_probabilities,
    write_labelled_copy,
)
from sb3_offline.labelling.calibration import calibrate

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


@pytest.fixture(scope="module")
def labels(data):
    return label_episodes(str(data), goal_examples(), settings=SETTINGS, device="cpu")


@pytest.fixture(scope="module")
def solved(data):
    dataset = OfflineDataset(data)
    inside = near_goal(np.asarray(dataset.observations))
    return np.array(
        [inside[s + 1 : s + n + 1].any() for s, n in zip(dataset.observation_starts, dataset.lengths, strict=True)]
    )


def test_episodes_are_judged_and_counted_without_labels(data, labels, solved):
    check = check_labels(labels, solved)
    assert check.auc > 0.99 and check.precision > 0.9 and check.recall > 0.85 and check.successes == solved.sum()
    precision, successes = labels.estimated_precision, labels.estimated_successes
    assert precision.low <= precision.value <= precision.high and precision.value > 0.85
    assert successes.low <= successes.value <= successes.high and successes.value == pytest.approx(solved.sum(), rel=0.2)
    assert labels.best(7).sum() == 7 and labels.scores[labels.best(7)].min() >= labels.scores[~labels.best(7)].max()
    by_episode = np.logical_or.reduceat(labels.success, OfflineDataset(data).step_starts)
    np.testing.assert_array_equal(by_episode, labels.detected)
    assert not labels.warnings


def test_examples_unlike_the_data_are_doubted(data):
    few = ClassifierSettings(gradient_steps=2)
    doubted = label_episodes(str(data), goal_examples() + np.float32(1.0), settings=few, device="cpu")
    assert any("50 of 50 are unlike every observation of the data" in warning for warning in doubted.warnings)


def test_the_check_counts_ties_by_half():
    def check(ranking, solved):
        n = len(ranking)
        nothing = Estimate(0, 0, 0)
        labels = EpisodeLabels(np.zeros(n), np.ones(n, int), np.array(ranking), np.array(ranking), nothing, nothing, 0)
        return check_labels(labels, np.array(solved, bool))

    assert check([0.9, 0.6, 0.4, 0.1], [1, 0, 1, 0]) == (0.75, 0.5, 0.5, 2)
    assert check([0.5, 0.5], [1, 0]).auc == 0.5


def test_labels_return_from_their_file_and_belong_to_their_data(data, labels, tmp_path):
    path = tmp_path / "labels.h5"
    save_labels(path, labels, {"examples": "goal"})
    again = load_labels(path, [OfflineDataset(data)])
    for name in ("probabilities", "lengths", "ranking", "scores", "success", "detected"):
        np.testing.assert_array_equal(getattr(again, name), getattr(labels, name))
    for name in ("estimated_precision", "estimated_successes", "checksum", "made_with"):
        assert getattr(again, name) == getattr(labels, name)
    with pytest.raises(DatasetError, match="exists already"):
        save_labels(path, labels, overwrite=False)
    write_point_mass(tmp_path / "other.h5", n_episodes=240, seed=1)
    with pytest.raises(DatasetError, match=r"labels.h5.*hold 240 episodes of other data than .*other.h5"):
        load_labels(path, [OfflineDataset(tmp_path / "other.h5")])
    with pytest.raises(DatasetError, match="expected 'sb3-offline-labels'"):
        load_labels(data)


def test_a_labelled_copy_has_the_labels_as_its_success(data, labels, tmp_path):
    write_labelled_copy(tmp_path / "copy.h5", OfflineDataset(data), labels)
    copy, original = OfflineDataset(tmp_path / "copy.h5"), OfflineDataset(data)
    np.testing.assert_array_equal(copy.success, labels.success)
    for name in ("observations", "actions", "lengths", "seeds", "truncated"):
        np.testing.assert_array_equal(getattr(copy, name), getattr(original, name))
    assert sum(part.n_episodes for part in select_episodes(copy, success=True)) == labels.detected.sum()
    assert copy.provenance["labelled"]["seed"] == 0


def test_detected_episodes_are_selected(data, labels, tmp_path, monkeypatch):
    path = tmp_path / "labels.h5"
    calls = []
    monkeypatch.setattr("sb3_offline.labelling.selection.label_episodes", lambda *args, **kwargs: calls.append(1) or labels)
    for _ in range(2):  # made once
        (chosen,) = select_detected(data, labels=path, examples=goal_examples())
        np.testing.assert_array_equal(chosen.seeds, OfflineDataset(data).seeds[labels.detected])
    assert len(calls) == 1
    (best,) = select_detected(data, 5, labels=labels)
    np.testing.assert_array_equal(best.seeds, OfflineDataset(data).seeds[labels.best(5)])
    with pytest.raises(DatasetError, match="were made from other examples"):
        select_detected(data, labels=path, examples=goal_examples(seed=2))
    with pytest.raises(RuntimeError, match="need `labels`"):
        select_detected(data)


def test_configs_learn_from_detected_episodes_and_steps(data, labels, tmp_path):
    """Of a config, BC gets the detected episodes and no examples, and CQL a reward for each detected step."""
    file = tmp_path / "labels.h5"
    save_labels(file, labels)
    config = {"policy": "MlpPolicy", "dataset": str(data), "labels": str(file), "policy_kwargs": {"net_arch": [8]}}
    model = create_model("bc", {**config, "examples": goal_examples(), "episodes": {"detected": True}}, device="cpu")
    assert model.replay_buffer.size() == labels.lengths[labels.detected].sum()
    model = create_model("cql", {**config, "reward_fn": "detected"}, device="cpu")
    np.testing.assert_array_equal(model.replay_buffer.rewards, labels.success)
    for episodes in ({"detected": True, "source": "a"}, {"detected": 0}, {"detected": "yes"}):
        with pytest.raises(RuntimeError, match="give `detected` alone"):
            create_model("bc", {**config, "episodes": episodes})
    with pytest.raises(RuntimeError, match="need `labels`"):
        create_model("cql", {"policy": "MlpPolicy", "dataset": str(data), "reward_fn": "detected"})


def test_labels_are_rewards_of_their_own_data_alone(data, labels, tmp_path):
    model = CQL("MlpPolicy", None, dataset=str(data), reward_fn=labels, policy_kwargs={"net_arch": [8]}, device="cpu")
    np.testing.assert_array_equal(model.replay_buffer.rewards, labels.success)
    write_point_mass(tmp_path / "other.h5", n_episodes=5)
    other = CQL("MlpPolicy", None, dataset=str(tmp_path / "other.h5"), reward_fn=labels, device="cpu")
    with pytest.raises(DatasetError, match="episodes of other data than"):
        other.learn(1)
    with pytest.raises(TypeError, match=r"label_episodes\(dataset, examples\)"):
        CQL("MlpPolicy", None, dataset=str(data), reward_fn="detected")


def write_images(path, n_episodes=40, n_steps=8, keys=False):
    """A light wanders over dark images; in a quarter of the episodes it ends in the lower right corner, which is success."""
    rng = np.random.default_rng(0)
    images = spaces.Box(0, 255, (36, 36, 3), np.uint8)
    space = spaces.Dict({"image": images, "clock": spaces.Box(0, 1, (1,), np.float32)}) if keys else images
    with DatasetWriter(path, space, ACTIONS, rewards=False) as writer:
        for episode in range(n_episodes):
            places = rng.integers(0, 18, size=(n_steps + 1, 2))
            places[n_steps - 2 :] = 28 if episode % 4 == 0 else places[n_steps - 2 :]
            frames = np.stack([light_at(*place) for place in places])
            observations = {"image": frames, "clock": rng.random((n_steps + 1, 1), np.float32)} if keys else frames
            success = (places > 20).all(axis=1)[1:]
            writer.add_episode(observations, np.zeros((n_steps, 2), np.float32), success=success)
    return np.arange(n_episodes) % 4 == 0


def light_at(row, column):
    image = np.full((36, 36, 3), 20, np.uint8)
    image[row : row + 8, column : column + 8] = 230
    return image


@pytest.mark.parametrize("keys", [False, True], ids=["images", "dict"])
def test_images_are_labelled_and_shown(keys, tmp_path, capsys):
    solved = write_images(tmp_path / "lights.h5", keys=keys)
    examples = {"image": np.stack([light_at(28, 28)] * 12)}
    if keys:
        examples["clock"] = np.random.default_rng(1).random((12, 1), np.float32)
    np.savez(tmp_path / "examples.npz", **examples)
    arguments = ["--examples", str(tmp_path / "examples.npz"), "--steps", "25", "--html", str(tmp_path / "page.html")]
    arguments += ["-o", str(tmp_path / "labels.h5"), "--copy", str(tmp_path / "copy.h5"), "--check"]
    main(["label", str(tmp_path / "lights.h5"), *arguments, "--device", "cpu"])
    labels = load_labels(tmp_path / "labels.h5")
    np.testing.assert_array_equal(labels.detected, solved)
    np.testing.assert_array_equal(OfflineDataset(tmp_path / "copy.h5").success, OfflineDataset(tmp_path / "lights.h5").success)
    said = capsys.readouterr().out
    assert "10 of 40 episodes look like the examples." in said and "AUC 1.0000, precision 1.000, recall 1.000" in said
    page = (tmp_path / "page.html").read_text()
    assert page.count('alt="frame"') == 10 + 24 + 10 and 'alt="example 0"' in page and "AUC, by the labels" in page
    with pytest.raises(SystemExit, match=r"labels.h5: file: exists already\. Give --overwrite"):
        main(["label", str(tmp_path / "lights.h5"), *arguments])
    with pytest.raises(SystemExit, match="extras/x:2: is missing"):
        main(["label", str(tmp_path / "lights.h5"), *arguments[:2], "--check", "extras/x:2"])


def test_states_have_a_page_of_scores(data, labels, tmp_path):
    write_label_page(tmp_path / "page.html", JoinedDatasets(data), labels, goal_examples())
    page = (tmp_path / "page.html").read_text()
    assert "There are no frames" in page and page.count("<tbody>") == 3 and f"<b>{labels.detected.sum()}</b>" in page
