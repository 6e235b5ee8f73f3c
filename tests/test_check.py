"""Damage is found and named: checksums of episodes, and the command that compares them."""

import os
import shutil
import time
import zipfile

import h5py
import numpy as np
import pytest
from data_files import ACTIONS, BOTH, IMAGES, OPTIONS, STATES, forget_checksums, make_episode, write_dataset

from sb3_offline.cli import main
from sb3_offline.data.check import Verdict, check_dataset, check_examples, rescue
from sb3_offline.data.convert import convert
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import load_examples, save_examples
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.experiment.check import check, check_all
from sb3_offline.experiment.policy_file import save_policy
from sb3_offline.experiment.training import load_run, train


def flip(path, name, row, bit=0):
    """Flip one bit of a row of a contiguous array, as a disk might."""
    with h5py.File(path) as file:
        array = file[name]
        offset = array.id.get_offset() + row * int(np.prod(array.shape[1:], dtype=int)) * array.dtype.itemsize
    with open(path, "r+b") as file:
        file.seek(offset)
        byte = file.read(1)[0]
        file.seek(offset)
        file.write(bytes([byte ^ (1 << bit)]))


@pytest.fixture
def path(tmp_path):
    write_dataset(tmp_path / "d.h5", space=BOTH)
    return tmp_path / "d.h5"


ARRAYS = ["actions", "rewards", "success", "episodes/seed", "observations/state"]


@pytest.mark.parametrize("name", [*ARRAYS, "observations/image", "extras/qpos"])
def test_a_flipped_bit_is_named_by_array_and_episode(path, name):
    dataset = OfflineDataset(path)
    per_episode = name.startswith("episodes/")
    starts = dataset.observation_starts if name.startswith("observations") else dataset.step_starts
    row = 5 if per_episode else int(starts[5])
    del dataset, starts
    flip(path, name, row)
    message = f"{name}: episode 5 does not match the checksums"
    (line,) = check_dataset(path).damages
    assert f"d.h5: {message}" in line and "11 episodes are intact (0-4, 6-11); to copy them: sb3-offline check" in line
    if name in ARRAYS:  # opening reads these anyway
        with pytest.raises(DatasetError, match=message):
            OfflineDataset(path)
    with pytest.raises(DatasetError, match=message):
        convert(path, path.with_name("copy.h5"), progress_bar=False)
    assert not path.with_name("copy.h5").exists()
    assert rescue(path, path.with_name("rest.h5")) == (11, 1)
    assert OfflineDataset(path.with_name("rest.h5")).seeds.tolist() == [0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11]
    assert check_dataset(path.with_name("rest.h5")).damages == []
    with pytest.raises(DatasetError, match="episode 5 does not match"):
        OfflineDataset(path, episodes=[5])


def test_damage_that_hides_where_episodes_lie(tmp_path):
    episodes = [make_episode(index, n=4) for index in range(6)]
    with DatasetWriter(tmp_path / "d.h5", IMAGES, ACTIONS, **OPTIONS) as writer:
        for episode in episodes:
            writer.add_episode(**episode)
    shutil.copy(tmp_path / "d.h5", tmp_path / "short.h5")
    flip(tmp_path / "short.h5", "episodes/length", 2, bit=0)  # 5 steps in place of 4: more than there are
    assert "has 30 rows, but 6 episodes of 25 steps need 31" in check_dataset(tmp_path / "short.h5").damages[0]
    shutil.copy(tmp_path / "d.h5", tmp_path / "one.h5")
    with h5py.File(tmp_path / "one.h5", "r+") as file:
        file["episodes/length"][2] = 3
    (line,) = check_dataset(tmp_path / "one.h5").damages
    assert "episodes/length: episode 2 does not match" in line and "2 episodes are intact (0-1)" in line
    assert rescue(tmp_path / "one.h5", tmp_path / "rest.h5") == (2, 4)
    with h5py.File(tmp_path / "d.h5", "r+") as file:
        file["n_episodes"][()] = 3  # of six
    with pytest.raises(DatasetError, match=r"n_episodes: is 3, but the file holds more episodes"):
        OfflineDataset(tmp_path / "d.h5")


def test_an_episode_that_a_kill_left_uncounted_is_no_damage(tmp_path, monkeypatch):
    writer = DatasetWriter(tmp_path / "d.h5", IMAGES, ACTIONS, **OPTIONS)
    for index in range(3):
        writer.add_episode(**make_episode(index))
    shutil.copy(tmp_path / "d.h5", tmp_path / "killed.h5")
    writer.close()
    assert check_dataset(tmp_path / "killed.h5").lines()[1:] == []
    with h5py.File(tmp_path / "killed.h5", "r+") as file:
        file["n_episodes"][()] = 2
    verdict = check_dataset(tmp_path / "killed.h5")
    assert verdict.damages == [] and "one more episode follow" in verdict.notes[0]


@pytest.mark.parametrize("change", ["attribute", "array", "column"])
def test_attributes_and_the_list_of_arrays_are_checked_too(path, change):
    with h5py.File(path, "r+") as file:
        if change == "attribute":
            file.attrs["env_kwargs"] = '{"task": "other"}'
        elif change == "array":
            del file["rewards"]
        else:
            del file["episodes/crc"]
    message = {"attribute": "attributes: do not match", "array": "rewards: is missing", "column": "episodes/crc: is missing"}
    with pytest.raises(DatasetError, match=f"d.h5: {message[change]}"):
        OfflineDataset(path)


def test_files_without_checksums_open_and_get_some_when_appended_to(path):
    with h5py.File(path, "r+") as file:
        forget_checksums(file)
    assert OfflineDataset(path).checksums is None
    assert "has no checksums" in check_dataset(path).notes[0]
    with DatasetWriter(path, BOTH, ACTIONS, **OPTIONS, mode="a", capacity=(1, 1)) as writer:
        for index in (12, 13):
            writer.add_episode(**make_episode(index, BOTH))
    verdict = check_dataset(path)
    assert verdict.damages == verdict.notes == [] and "14 episodes" in verdict.contents
    flip(path, "observations/image", 3)
    assert "episode 0 does not match" in check_dataset(path).damages[0]


def test_both_storages_and_selections_keep_checksums(path, tmp_path):
    convert(path, tmp_path / "c.h5", "compressed", progress_bar=False)
    convert(tmp_path / "c.h5", tmp_path / "again.h5", progress_bar=False)
    assert check_dataset(tmp_path / "c.h5").damages == [] and check_dataset(tmp_path / "c.h5").notes == []
    with h5py.File(path) as one, h5py.File(tmp_path / "again.h5") as other:
        np.testing.assert_array_equal(one["episodes/crc"], other["episodes/crc"])
    with h5py.File(tmp_path / "c.h5", "r+") as file:
        file["observations/image"][2] ^= 1
    assert "observations/image: episode 0 does not match" in check_dataset(tmp_path / "c.h5").damages[0]


def test_examples_have_a_checksum(tmp_path):
    save_examples(tmp_path / "e.h5", np.zeros((4, 3), np.float32), STATES)
    assert check_examples(tmp_path / "e.h5").lines() == [f"ok: {tmp_path / 'e.h5'}: 4 success examples"]
    flip(tmp_path / "e.h5", "observations", 2)
    with pytest.raises(DatasetError, match=r"e.h5: observations: does not match the checksum"):
        load_examples(tmp_path / "e.h5", STATES)


def test_a_file_that_hdf5_would_read_for_ever_is_refused(path):
    raw = bytearray(path.read_bytes())
    heap = raw.find(b"GCOL\x01")
    assert heap > 0
    raw[heap + 16 : heap + 1000] = bytes(984)  # a block of zeros
    path.write_bytes(raw)
    assert "damaged heap of texts" in check_dataset(path).damages[0]


# --- The command ---


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Data, a run and its policy."""
    folder = tmp_path_factory.mktemp("all")
    write_dataset(folder / "d.h5", space=STATES)
    save_examples(folder / "e.h5", np.zeros((4, 3), np.float32), STATES)
    np.savez(folder / "e.npz", observations=np.zeros((4, 3)))
    config = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "n_timesteps": 4}
    train("bc", "Pendulum-v1", config, folder / "run", dataset=str(folder / "d.h5"), progress_bar=False)
    save_policy(folder / "policy.npz", *load_run(folder / "run/model.zip"))
    return folder


def test_everything_that_is_written_can_be_checked(folder, tmp_path, capsys):
    (tmp_path / "text.h5").write_text("no dataset")
    with pytest.raises(SystemExit) as ended:
        main(["check", str(folder), str(folder / "*.npz"), str(tmp_path), str(tmp_path / "none.h5")])
    assert ended.value.code == 1
    out = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in out] == ["ok"] * 7 + ["damaged"] * 2
    assert "run: run with model, record and tables" in out[0] and "has no known format" in out[-2] and "not exist" in out[-1]


@pytest.mark.parametrize("name", ["run/model.zip", "policy.npz", "run/config.yml"])
def test_damaged_runs_and_policies_are_named(folder, tmp_path, name):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    raw, place = bytearray((copy / name).read_bytes()), 20
    if not name.endswith(".yml"):  # in the largest member of the archive
        with zipfile.ZipFile(copy / name) as archive:
            largest = max(archive.infolist(), key=lambda member: member.compress_size)
            place = largest.header_offset + 60 + largest.compress_size // 2
    raw[place] ^= 0x80
    (copy / name).write_bytes(raw)
    place = copy / "run" if name.startswith("run") else copy / name
    verdict = check(str(place))
    assert len(verdict.damages) == 1 and name in verdict.damages[0]


def die_or_hang(path, trust):
    if "crash" in path:
        os._exit(11)
    if "hang" in path:
        time.sleep(60)
    return Verdict(path, "fine", [], [])


def test_a_crash_or_a_hang_is_a_verdict(tmp_path):
    verdicts = list(check_all(["a", "crash", "hang", "c"], seconds=2, check_one=die_or_hang))
    assert [verdict.path for verdict in verdicts] == ["a", "crash", "hang", "c"]
    assert "crash (exit code 11)" in verdicts[1].damages[0] and "too long" in verdicts[2].damages[0]
    assert not any(verdicts[index].damages for index in (0, 3))
