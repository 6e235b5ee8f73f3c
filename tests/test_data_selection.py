"""Selection of episodes by their labels: in datasets, in a config, and for a learner."""

import pickle

import numpy as np
import pytest
from data_files import ACTIONS, BOTH, STATES, make_episode, write_dataset

from sb3_offline import BC
from sb3_offline.data.convert import convert
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.selection import select_episodes
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.experiment.training import create_model


def solved(episode):
    return bool(episode["success"].any())


@pytest.mark.parametrize("storage", ["contiguous", "compressed"])
def test_selected_episodes_are_those_of_the_file(storage, tmp_path):
    episodes = write_dataset(tmp_path / "raw.h5", 40, BOTH)
    convert(tmp_path / "raw.h5", tmp_path / "d.h5", storage)
    (dataset,) = select_episodes(tmp_path / "d.h5", source="left", success=True)
    wanted = [episode for episode in episodes if episode["source"] == "left" and solved(episode)]
    assert 1 < len(wanted) == dataset.n_episodes < 20
    for again in (dataset, pickle.loads(pickle.dumps(dataset)).select(range(len(wanted)))):
        for e, episode in enumerate(wanted):
            step, row, n = again.step_starts[e], again.observation_starts[e], len(episode["actions"])
            for key, values in episode["observations"].items():
                np.testing.assert_array_equal(again.observations[key][row : row + n + 1], values)
            for name in ("actions", "rewards", "success", "terminated"):
                np.testing.assert_array_equal(again.arrays[name][step : step + n], episode[name])
            np.testing.assert_array_equal(again.extras["qpos"][step : step + n], episode["extras"]["qpos"])
            assert again.seeds[e] == episode["seed"] and again.lengths[e] == n


def test_failures_of_one_source_are_failures_of_that_source(tmp_path):
    episodes = write_dataset(tmp_path / "d.h5", 40)
    (dataset,) = select_episodes(tmp_path / "d.h5", source="left", success=False)
    wanted = [episode["seed"] for episode in episodes if episode["source"] == "left" and not solved(episode)]
    assert len(wanted) > 0 and dataset.seeds.tolist() == wanted


def test_files_without_selected_episodes_are_left_out(tmp_path):
    for first in (0, 1):
        write_dataset(tmp_path / f"{first}.h5", 1, first=first)  # "right", "left"
    (only,) = select_episodes(str(tmp_path / "*.h5"), source="left")
    assert only.path.name == "1.h5"
    write_dataset(tmp_path / "2.h5", 1, sources=["right"])  # one file a source
    assert [part.path.name for part in select_episodes(str(tmp_path / "*.h5"), source="right")] == ["0.h5", "2.h5"]


def test_impossible_selections_are_named(tmp_path):
    write_dataset(tmp_path / "d.h5", 3)
    with DatasetWriter(tmp_path / "unlabelled.h5", STATES, ACTIONS, rewards=False, success=False) as writer:
        writer.add_episode(np.zeros((3, 3)), np.zeros((2, 2)))
    with pytest.raises(DatasetError, match=r"d\.h5: source: has no 'middle'.*left"):
        select_episodes(tmp_path / "d.h5", source="middle")
    with pytest.raises(DatasetError, match=r"unlabelled\.h5: success: is missing"):
        select_episodes(tmp_path / "unlabelled.h5", success=True)
    with pytest.raises(DatasetError, match=r"one\.h5: episodes: holds no episode with .*right.*False"):
        write_dataset(tmp_path / "one.h5", 1)
        select_episodes(tmp_path / "one.h5", source="right", success=not solved(make_episode(0)))
    config = {"policy": "MlpPolicy", "n_timesteps": 1, "episodes": {"source": "{task}"}}
    with pytest.raises(RuntimeError, match=r"names 'task'.*--task"):
        create_model("bc", config, str(tmp_path / "d.h5"))
    with pytest.raises(RuntimeError, match="`source` and `success`"):
        create_model("bc", {**config, "episodes": {"rewards": 1}}, str(tmp_path / "d.h5"))


def test_masks_select_episodes(tmp_path):
    write_dataset(tmp_path / "d.h5", 4)
    dataset = OfflineDataset(tmp_path / "d.h5")
    chosen = dataset.select(np.array([False, True, False, True]))
    assert chosen.seeds.tolist() == [1, 3] and chosen.select([False, True]).seeds.tolist() == [3]
    for wrong, message in (([True, False], "mask of 2"), ([4], "names episode 4"), ([-1], "names episode -1")):
        with pytest.raises(DatasetError, match=rf"d\.h5: episodes: .*{message}"):
            dataset.select(wrong)


def test_a_config_selects_the_episodes_to_learn_from(tmp_path):
    episodes = write_dataset(tmp_path / "d.h5", space=STATES)
    config = {
        "policy": "MlpPolicy",
        "n_timesteps": 1,
        "env_kwargs": {"task": "left"},
        "episodes": {"source": "{task}", "success": True},
        "batch_size": 4,
    }
    model = create_model("bc", config, str(tmp_path / "d.h5")).learn(1)
    wanted = [episode["actions"] for episode in episodes if episode["source"] == "left" and solved(episode)]
    middle, half = (ACTIONS.high + ACTIONS.low) / 2, (ACTIONS.high - ACTIONS.low) / 2
    np.testing.assert_allclose(model.replay_buffer.actions, (np.concatenate(wanted) - middle) / half, atol=1e-6)
    model.save(tmp_path / "model")
    (tmp_path / "d.h5").unlink()
    assert BC.load(tmp_path / "model").dataset is None  # a model predicts without its data
