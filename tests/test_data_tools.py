import json
import os

import numpy as np
import pytest
from data_files import ACTIONS, BOTH, IMAGES, STATES, write_dataset
from gymnasium import spaces

from sb3_offline import cli
from sb3_offline.data.convert import convert
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.data_tools.inspecting.dataset_statistics import inspect_dataset
from sb3_offline.data_tools.inspecting.summary import format_summary


@pytest.mark.parametrize("space", [IMAGES, BOTH])
def test_to_compressed_and_back_loses_nothing(tmp_path, space):
    original, small, back = (tmp_path / name for name in ("a.h5", "small.h5", "back.h5"))
    write_dataset(original, 30, space, env_id="Some-v0", env_kwargs={"task": "x"}, provenance={"seed": 3})
    convert(original, small, "compressed", progress_bar=False)
    cli.main(["convert", str(small), str(back), "--storage", "contiguous"])
    first, middle, last = map(OfflineDataset, (original, small, back))
    assert [dataset.storage for dataset in (first, middle, last)] == ["contiguous", "compressed", "contiguous"]
    for other in (middle, last):
        assert other.header == first.header and other.arrays.keys() == first.arrays.keys()
        for name, array in first.arrays.items():
            np.testing.assert_array_equal(other.arrays[name], array)
            if len(array) > 5:  # slices, scattered rows and single ones, as of an array
                rows = np.array([5, 0, 5])
                np.testing.assert_array_equal(other.arrays[name][2:4], array[2:4])
                np.testing.assert_array_equal(other.arrays[name][rows], array[rows])
                np.testing.assert_array_equal(other.arrays[name][-1], array[-1])
    assert original.read_bytes() == back.read_bytes()
    with pytest.raises(DatasetError, match=r"compressed and cannot be appended to.*Convert"):
        DatasetWriter(small, space, ACTIONS, mode="a")


def test_a_killed_writers_file_is_compressed_without_its_spare_room(tmp_path):
    writer = DatasetWriter(tmp_path / "a.h5", STATES, ACTIONS, rewards=False, success=False)
    for _ in range(3):
        writer.add_episode(np.zeros((3, 3)), np.zeros((2, 2)))
    convert(tmp_path / "a.h5", tmp_path / "b.h5", "compressed", progress_bar=False)
    writer.close()
    assert OfflineDataset(tmp_path / "b.h5").n_episodes == 3
    assert OfflineDataset(tmp_path / "b.h5").actions.shape == (6, 2)


def test_an_interrupted_conversion_leaves_nothing(tmp_path, monkeypatch):
    write_dataset(tmp_path / "a.h5")
    write_dataset(tmp_path / "b.h5", 2)
    before = (tmp_path / "b.h5").read_bytes()
    with pytest.raises(DatasetError, match=r"b.h5: file: exists already"):
        convert(tmp_path / "a.h5", tmp_path / "b.h5", "compressed")
    with pytest.raises(TypeError, match="storage is 'zip'; choose 'contiguous' or 'compressed'"):
        convert(tmp_path / "a.h5", tmp_path / "c.h5", "zip", progress_bar=False)

    def interrupt(*args):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("sb3_offline.data.convert.tqdm.update", interrupt)
        convert(tmp_path / "a.h5", tmp_path / "b.h5", "compressed", overwrite=True, progress_bar=False)
    assert sorted(os.listdir(tmp_path)) == ["a.h5", "b.h5"] and (tmp_path / "b.h5").read_bytes() == before
    convert(tmp_path / "b.h5", tmp_path / "b.h5", "compressed", overwrite=True, progress_bar=False)
    assert OfflineDataset(tmp_path / "b.h5").storage == "compressed"


def test_summary_of_a_sound_file(tmp_path, capsys):
    episodes = write_dataset(tmp_path / "a.h5", 30, env_id="Some-v0", provenance={"policy": "random"})
    cli.main(["inspect", "--json", str(tmp_path / "a.h5")])
    summary = json.loads(capsys.readouterr().out)
    left = [episode for episode in episodes if episode["source"] == "left"]
    group = summary["groups"]["left"]
    assert group["episodes"] == 15 and group["steps"] == sum(len(episode["actions"]) for episode in left)
    assert group["success"] == pytest.approx(np.mean([episode["success"].any() for episode in left]))
    assert group["success_at_end"] == pytest.approx(np.mean([episode["success"][-1] for episode in left]))
    assert group["return"]["mean"] == pytest.approx(np.mean([episode["rewards"].sum() for episode in left]), rel=1e-5)
    assert summary["terminated"] == 10 and summary["truncated"] == 20
    scaled = np.concatenate([episode["actions"] for episode in episodes]) / [2, 5] - [0, 1]
    assert summary["actions"]["saturated"] == pytest.approx((np.abs(scaled) > 0.99).mean(axis=0).tolist(), abs=1e-6)
    assert summary["warnings"] == []
    text = format_summary(summary)
    for part in ("Some-v0", "random", "left", f"{group['success']:.1%}", "no warnings"):
        assert part in text


def test_warnings_of_an_unsound_file(tmp_path):
    space = spaces.Dict({"state": spaces.Box(-1, 1, (3,)), "image": IMAGES})
    state = np.random.default_rng(0).uniform(-1, 1, (9, 3))
    state[:, 1], state[4, 0] = 0.5, 7
    noise = np.random.default_rng(1).normal(size=(8, 2))
    noise[3, 1] = np.nan
    observations = {"state": state, "image": np.zeros((9, 8, 6, 3), np.uint8)}
    path, extras = tmp_path / "a.h5", {"noise": ((2,), np.float32)}
    with DatasetWriter(path, space, ACTIONS, extras=extras) as writer:
        for _ in range(2):
            # NaN is refused by the writer, so it is put in below
            episode = {"rewards": np.zeros(8), "success": np.zeros(8), "extras": {"noise": np.nan_to_num(noise)}}
            writer.add_episode(observations, np.full((8, 2), 3.0), **episode, truncated=np.zeros(8))
    import h5py

    with h5py.File(path, "r+") as file:
        file["extras/noise"][3] = noise[3]
    summary = inspect_dataset(path)
    text = "\n".join(f"{warning['field']}: {warning['problem']}" for warning in summary["warnings"])
    for message in (
        "actions: 100.0% of the steps are outside the action space",
        "success: no step is labelled",
        "terminated, truncated: 2 episodes end without either",
        "extras/noise: 1 rows hold NaN",
        "observations/state: never changes in 1 of 3 columns (1)",
        "observations/state: outside the observation space in 1 columns (0)",
        "observations/image: 100.0% of 18 sampled images are of one colour",
        "rewards: never changes",
        "episodes: 1 repeat an earlier one (1)",
    ):
        assert message in text
        assert message in format_summary(summary)
    write_dataset(tmp_path / "empty.h5", 0)
    assert "there is no episode" in format_summary(inspect_dataset(tmp_path / "empty.h5"))
