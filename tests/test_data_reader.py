import os
import pickle

import h5py
import numpy as np
import pytest
from data_files import ACTIONS, BOTH, IMAGES, STATES, forget_checksums, make_episode, write_dataset
from gymnasium import spaces

from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.convert import convert
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import load_examples, save_examples
from sb3_offline.data.reader import OfflineDataset, open_datasets


def cut_file(path):
    os.truncate(path, os.path.getsize(path) - 100)


def scribble(path):
    path.write_bytes(b"not a dataset")


def edit(change):
    def apply(path):
        with h5py.File(path, "r+") as file:
            change(file)

    return apply


def replace(name, change):
    def apply(file):
        values = change(file[name][()])
        del file[name]
        file[name] = values

    return edit(apply)


def set_row(name, row, value):
    return edit(lambda file: file[name].__setitem__(row, value))


def test_lengths_and_starts(tmp_path):
    episodes = write_dataset(tmp_path / "d.h5")
    dataset = OfflineDataset(tmp_path / "d.h5")
    lengths = [len(episode["actions"]) for episode in episodes]
    assert dataset.n_episodes == len(episodes) and dataset.n_steps == sum(lengths)
    assert dataset.lengths.tolist() == lengths
    assert dataset.step_starts.tolist() == [sum(lengths[:e]) for e in range(len(lengths))]
    assert dataset.observation_starts.tolist() == [sum(lengths[:e]) + e for e in range(len(lengths))]
    again = pickle.loads(pickle.dumps(dataset))
    assert again.path == dataset.path and len(pickle.dumps(dataset)) < 1000


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), "file: does not exist"),
        (cut_file, "file: is truncated. Copy or download it again"),
        (
            scribble,
            "file: has no known format: it is neither HDF5, .* begins with b'not a dataset'. .* its name promises a HDF5 file",
        ),
        (edit(lambda f: f.attrs.__setitem__("format", "minari")), "has no known format: it is an HDF5 file .*format='minari'"),
        (edit(lambda f: f.attrs.__setitem__("format_version", 2)), "format_version: is 2, this release reads 1. Update"),
        (edit(lambda f: f.attrs.__delitem__("action_space")), "attribute action_space: is missing"),
        (edit(lambda f: f.attrs.__setitem__("action_space", "Box(2,)")), "attribute action_space: cannot be understood"),
        (edit(lambda f: f.__delitem__("actions")), "actions: is missing"),
        (replace("rewards", lambda a: a[:-3]), r"rewards: has \d+ rows, but 12 episodes of \d+ steps need \d+"),
        (replace("observations", lambda a: a[:-12]), r"observations: has \d+ rows, but 12 episodes"),
        (
            replace("observations", lambda a: a.astype(np.int32)),
            "observations: holds rows of shape .* int32, expected .* uint8",
        ),
        (replace("actions", lambda a: a[:, :1]), r"actions: holds rows of shape \(1,\)"),
        (replace("n_episodes", lambda a: 99), "n_episodes: is 99, but episodes/length has 12 rows"),
        (set_row("episodes/length", 3, -1), "episodes/length: holds an episode of -1 steps"),
        (set_row("episodes/length", 3, 1000), r"observations: has \d+ rows, but 12 episodes"),
        (set_row("episodes/source", 3, 2), "episodes/source: has indices up to 2, but there are 2 labels"),
        (set_row("actions", (5, 1), np.nan), "actions: holds NaN or infinity, first in row 5"),
        (set_row("rewards", 6, np.inf), "rewards: holds NaN or infinity, first in row 6"),
        (set_row("terminated", slice(None), True), "terminated: is true before the last step of an episode .*Split"),
    ],
)
def test_damage_is_named_by_file_field_and_remedy(tmp_path, damage, message):
    path = tmp_path / "d.h5"
    write_dataset(path)
    damage(path)
    with pytest.raises(DatasetError, match=message) as caught:
        OfflineDataset(path)
    error = caught.value
    assert str(path) in str(error) and error.field and error.remedy and isinstance(error, RuntimeError)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


@pytest.mark.parametrize("locking", [None, True, False])
def test_file_that_its_user_has_open_too(tmp_path, locking):
    write_dataset(tmp_path / "d.h5")
    with h5py.File(tmp_path / "d.h5", locking=locking) as file:
        assert OfflineDataset(tmp_path / "d.h5").n_steps == len(file["actions"])


@pytest.mark.parametrize("storage", ["contiguous", "compressed"])
@pytest.mark.parametrize("state", [STATES, spaces.Box(-1, 1, (4, 3)), spaces.Box(-9, 9, (3, 4, 1))])
def test_nan_in_states_is_found(tmp_path, monkeypatch, storage, state):
    monkeypatch.setattr("sb3_offline.data.checks.CHECK_BYTES", 100)  # several pieces
    write_dataset(tmp_path / "whole.h5", space=spaces.Dict({"image": IMAGES, "state": state}))
    convert(tmp_path / "whole.h5", tmp_path / "d.h5", storage, progress_bar=False)
    assert OfflineDataset(tmp_path / "d.h5").storage == storage
    set_row("observations/state", (7, 2), np.nan)(tmp_path / "d.h5")
    with pytest.raises(DatasetError, match=r"d.h5: observations/state: holds NaN or infinity, first in row 7. Leave"):
        OfflineDataset(tmp_path / "d.h5")


def test_lists_and_patterns_of_files(tmp_path):
    for name, first in (("b", 5), ("a", 0), ("c", 10)):
        write_dataset(tmp_path / f"{name}.h5", 3, first=first)
    by_pattern = open_datasets(str(tmp_path / "[ab].h5"))
    assert [dataset.path.name for dataset in by_pattern] == ["a.h5", "b.h5"]
    mixed = open_datasets([tmp_path / "c.h5", by_pattern[0], str(tmp_path / "b*.h5")])
    assert [dataset.path.name for dataset in mixed] == ["c.h5", "a.h5", "b.h5"]
    with pytest.raises(DatasetError, match="matches no file"):
        open_datasets(str(tmp_path / "*.hdf5"))
    with pytest.raises(DatasetError, match="names no file"):
        open_datasets([])


def test_files_that_do_not_belong_together(tmp_path):
    write_dataset(tmp_path / "a.h5", 3)
    write_dataset(tmp_path / "b.h5", 3, space=STATES)
    with pytest.raises(DatasetError, match=r"b.h5: observation_space: is Box.* in .*a.h5"):
        open_datasets(str(tmp_path / "*.h5"))
    replace("rewards", lambda a: a)(tmp_path / "a.h5")
    write_dataset(tmp_path / "c.h5", 3)
    edit(lambda file: (file.__delitem__("rewards"), forget_checksums(file)))(tmp_path / "c.h5")
    with pytest.raises(DatasetError, match=r"c.h5: rewards: are missing, but .*a.h5 has them"):
        open_datasets([tmp_path / "a.h5", tmp_path / "c.h5"])


def n_open_in(folder):
    links = [os.path.join("/proc/self/fd", name) for name in os.listdir("/proc/self/fd")]
    return sum(os.path.realpath(link).startswith(str(folder)) for link in links)


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="needs a list of open files")
@pytest.mark.parametrize("storage", ["mmap", "memory"])
def test_more_files_than_may_be_open(tmp_path, monkeypatch, storage):
    monkeypatch.setattr("sb3_offline.data.arrays.MAX_OPEN_MAPS", 3)
    for index in range(20):
        write_dataset(tmp_path / f"{index:02d}.h5", 1, BOTH, first=index)
    episodes = [make_episode(index, BOTH) for index in range(20)]
    buffer = OfflineReplayBuffer(str(tmp_path / "*.h5"), BOTH, ACTIONS, "cpu", storage=storage)
    for _ in range(2):
        batch = buffer.transitions(np.arange(buffer.size()))
        for key, values in batch.observations.items():
            wanted = np.concatenate([episode["observations"][key][:-1] for episode in episodes])
            np.testing.assert_array_equal(values, wanted)
    assert n_open_in(tmp_path) <= 3
    views = [dataset.observations["state"] for dataset in buffer.datasets]  # maps stay open while there are views of them
    for view, episode in zip(views, episodes, strict=True):
        np.testing.assert_array_equal(view, episode["observations"]["state"])
    del views, view, buffer
    assert n_open_in(tmp_path) == 0


def test_a_file_that_was_replaced_is_not_read_as_the_one_that_was_opened(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_offline.data.arrays.MAX_OPEN_MAPS", 1)
    for name in ("a", "b"):
        write_dataset(tmp_path / f"{name}.h5", 3)
    first, second = open_datasets([tmp_path / "a.h5", tmp_path / "b.h5"])
    before = np.array(second.observations)
    write_dataset(tmp_path / "b.h5", 3, first=5, mode="w")
    np.testing.assert_array_equal(second.observations, before)  # still open
    assert len(first.observations) == len(before)
    with pytest.raises(DatasetError, match=r"b\.h5: file: was replaced or removed after the dataset was opened"):
        second.arrays["observations"][0]
    assert OfflineDataset(tmp_path / "b.h5").seeds.tolist() == [5, 6, 7]


def test_paths_in_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    write_dataset("~/a.h5", 3)
    convert("~/a.h5", "~/b.h5", progress_bar=False)
    save_examples("~/e.h5", OfflineDataset("~/b.h5").observations[:2], IMAGES)
    assert len(load_examples("~/e.h5", IMAGES)) == 2 and len(open_datasets("~/[ab].h5")) == 2
    assert sorted(os.listdir(tmp_path)) == ["a.h5", "b.h5", "e.h5"]


def d4rl_arrays(n=10):
    terminals, timeouts = np.zeros(n, bool), np.zeros(n, bool)
    terminals[3], timeouts[7] = True, True  # steps 0-3 end, 4-7 are cut off by time, 8-9 by the end of the file
    return {
        "observations": np.arange(n, dtype=np.float32)[:, None] + [0, 0.5],
        "actions": np.linspace(-1, 1, n, dtype=np.float32)[:, None],
        "rewards": np.arange(n, dtype=np.float32),
        "terminals": terminals,
        "timeouts": timeouts,
    }


def write_arrays(path, arrays):
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name] = array


def test_d4rl_file_with_next_observations(tmp_path):
    arrays = d4rl_arrays()
    arrays["next_observations"] = arrays["observations"] + 1
    write_arrays(tmp_path / "d.hdf5", arrays)
    dataset = OfflineDataset(tmp_path / "d.hdf5")
    assert dataset.lengths.tolist() == [4, 4, 2] and dataset.storage == "memory"
    assert dataset.observations[:, 0].tolist() == [0, 1, 2, 3, 4, 4, 5, 6, 7, 8, 8, 9, 10]
    assert dataset.rewards.tolist() == list(range(10))
    assert np.flatnonzero(dataset.terminated).tolist() == [3]
    assert np.flatnonzero(dataset.truncated).tolist() == [7, 9]
    assert dataset.action_space == spaces.Box(-1, 1, (1,)) and dataset.observation_space.shape == (2,)
    assert dataset.success is None


def test_d4rl_file_without_next_observations(tmp_path):
    write_arrays(tmp_path / "d.hdf5", d4rl_arrays())
    dataset = OfflineDataset(tmp_path / "d.hdf5")
    # The observations after steps 7 and 9 are unknown, so these steps are left out. Step 3 terminates and repeats its own.
    assert dataset.lengths.tolist() == [4, 3, 1]
    assert dataset.observations[:, 0].tolist() == [0, 1, 2, 3, 3, 4, 5, 6, 7, 8, 9]
    assert dataset.rewards.tolist() == [0, 1, 2, 3, 4, 5, 6, 8]
    assert np.flatnonzero(dataset.terminated).tolist() == [3]
    assert np.flatnonzero(dataset.truncated).tolist() == [6, 7]


def test_d4rl_file_without_timeouts(tmp_path):
    arrays = d4rl_arrays()
    del arrays["timeouts"]
    write_arrays(tmp_path / "d.hdf5", arrays)
    with pytest.warns(UserWarning, match=r"timeouts: are missing.*max_episode_steps"):
        assert OfflineDataset(tmp_path / "d.hdf5").lengths.tolist() == [4, 5]
    assert OfflineDataset(tmp_path / "d.hdf5", max_episode_steps=4).lengths.tolist() == [4, 3, 1]
    arrays["next_observations"] = arrays["observations"] + 1
    arrays["next_observations"][6] = 100  # the next row is of another episode
    write_arrays(tmp_path / "n.hdf5", arrays)
    dataset = OfflineDataset(tmp_path / "n.hdf5")
    assert dataset.lengths.tolist() == [4, 3, 3] and np.flatnonzero(dataset.truncated).tolist() == [6, 9]
    assert dataset.observations[[8, 9], 0].tolist() == [100, 7]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"actions": np.full((10, 1), 2.0)}, r"actions: reaches from 2 to 2, .*action_space"),
        ({"rewards": np.zeros(9)}, "rewards: has 9 rows, but actions has 10"),
        ({"rewards": np.zeros((10, 2))}, r"rewards: has shape \(10, 2\), expected \(10,\)"),
        ({"next_observations": np.zeros((10, 3))}, r"next_observations: has shape \(10, 3\), expected \(10, 2\)"),
        ({"observations": np.full((10, 2), np.nan)}, "observations: holds NaN or infinity"),
    ],
)
def test_bad_d4rl_files(tmp_path, change, message):
    path = tmp_path / "d.hdf5"
    write_arrays(path, {**d4rl_arrays(), **change})
    with pytest.raises(DatasetError, match=message):
        OfflineDataset(path)
    if "actions" in change:
        assert OfflineDataset(path, action_space=spaces.Box(-2, 2, (1,))).n_episodes == 3


def test_an_empty_file_opens(tmp_path):
    write_dataset(tmp_path / "d.h5", 0)
    dataset = OfflineDataset(tmp_path / "d.h5")
    assert (dataset.n_episodes, dataset.n_steps) == (0, 0) and dataset.observations.shape == (0, *IMAGES.shape)
    assert dataset.action_space == ACTIONS
