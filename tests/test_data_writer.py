import multiprocessing
import os
import struct
import time

import data_files
import numpy as np
import pytest
from data_files import ACTIONS, BOTH, IMAGES, OPTIONS, make_episode, write_dataset
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.format import read_header
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.spaces import space_from_json, space_to_json
from sb3_offline.data.writer import DatasetWriter


def assert_holds(dataset, episodes):
    assert dataset.n_episodes == len(episodes)
    for e, episode in enumerate(episodes):
        n, row, step = len(episode["actions"]), dataset.observation_starts[e], dataset.step_starts[e]
        observations = episode["observations"]
        if not isinstance(observations, dict):
            np.testing.assert_array_equal(dataset.observations[row : row + n + 1], observations)
        else:
            for key, part in observations.items():
                np.testing.assert_array_equal(dataset.observations[key][row : row + n + 1], part)
        for name in ("actions", "rewards", "terminated", "success"):
            np.testing.assert_array_equal(getattr(dataset, name)[step : step + n], episode[name])
        np.testing.assert_array_equal(
            dataset.truncated[step : step + n], np.arange(n) == n - 1 - n * episode["terminated"][-1]
        )
        np.testing.assert_array_equal(dataset.extras["qpos"][step : step + n], episode["extras"]["qpos"])
        assert dataset.seeds[e] == episode["seed"] and dataset.sources[dataset.source[e]] == episode["source"]


@pytest.mark.parametrize("space", [IMAGES, BOTH])
@pytest.mark.parametrize("capacity", [(1, 1), (12, 200)])
def test_what_is_written_is_read(tmp_path, space, capacity):
    about = {"env_id": "Some-v0", "env_kwargs": {"task": "x"}, "provenance": {"seed": 3, "policy": "random"}}
    episodes = write_dataset(tmp_path / "d.h5", space=space, capacity=capacity, **about)
    dataset = OfflineDataset(tmp_path / "d.h5")
    assert_holds(dataset, episodes)
    assert dataset.observation_space == space and dataset.action_space == ACTIONS
    assert {key: getattr(dataset, key) for key in about} == about
    assert os.listdir(tmp_path) == ["d.h5"]


def n_written(acknowledged):
    raw = acknowledged.read_bytes()
    return struct.unpack("q", raw)[0] if raw else 0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs SIGKILL")
def test_killed_at_random_moments_every_acknowledged_episode_is_there(tmp_path, monkeypatch):
    context = multiprocessing.get_context("forkserver")
    # The server imports everything once for all processes. It finds this folder by the environment only.
    monkeypatch.setenv("PYTHONPATH", os.path.dirname(__file__), prepend=os.pathsep)
    context.set_forkserver_preload(["data_files"])
    path, acknowledged = tmp_path / "d.h5", tmp_path / "acknowledged"
    rng = np.random.default_rng(0)
    n_before, kills_while_writing = 0, 0
    for _ in range(25):
        acknowledged.unlink(missing_ok=True)
        process = context.Process(target=data_files.write_until_killed, args=(path, acknowledged))
        process.start()
        wanted = n_before + int(rng.integers(0, 4))
        while not acknowledged.exists() or (wanted > n_before and n_written(acknowledged) < wanted):
            time.sleep(0.0002)
        time.sleep(rng.uniform(0, 0.01))
        process.kill()
        process.join()
        assert process.exitcode == -9
        n_acknowledged = n_written(acknowledged) or n_before
        if not path.exists():
            assert n_acknowledged == 0
            continue
        dataset = OfflineDataset(path)
        assert n_acknowledged <= dataset.n_episodes <= n_acknowledged + 1
        assert_holds(dataset, [make_episode(index) for index in range(dataset.n_episodes)])
        kills_while_writing += dataset.n_episodes > n_before
        n_before = dataset.n_episodes
    assert kills_while_writing > 5
    with DatasetWriter(path, IMAGES, ACTIONS, **OPTIONS, mode="a") as writer:
        writer.add_episode(**make_episode(n_before))
    assert_holds(OfflineDataset(path), [make_episode(index) for index in range(n_before + 1)])
    assert sorted(os.listdir(tmp_path)) == ["acknowledged", "d.h5"]


def test_a_failure_at_any_single_write_leaves_the_committed_episodes(tmp_path, monkeypatch):
    write, fsync = DatasetWriter._write, os.fsync
    log = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: (log.append("fsync"), fsync(descriptor)))
    monkeypatch.setattr(DatasetWriter, "_write", lambda self, place, array: (log.append(place), write(self, place, array)))
    for n_good_writes in range(20):
        path = tmp_path / f"{n_good_writes}.h5"
        writer = DatasetWriter(path, IMAGES, ACTIONS, **OPTIONS)
        writer.add_episode(**make_episode(0))
        log.clear()

        def fail(self, place, array, allowed=n_good_writes):
            if len(log) >= allowed:
                raise OSError("no space left on device")
            log.append(place)
            write(self, place, array[: len(array) // 2 + 1] if array.ndim else array)  # torn, too

        with monkeypatch.context() as patch:
            patch.setattr(DatasetWriter, "_write", fail)
            try:
                writer.add_episode(**make_episode(1, n=1))
            except OSError:
                assert_holds(OfflineDataset(path), [make_episode(0)])
            else:
                break
        writer.add_episode(**make_episode(2))
        writer.close()
        assert_holds(OfflineDataset(path), [make_episode(0), make_episode(2)])
    assert n_good_writes > 8  # every array once
    assert log[-2] == "fsync" and log[-1] == writer._offsets["n_episodes"] and log.index("fsync") == len(log) - 2


def test_append_adds_sources_and_provenance_and_refuses_other_contents(tmp_path):
    path = tmp_path / "d.h5"
    episodes = write_dataset(path, 3, provenance={"seed": 1})
    with DatasetWriter(
        path, IMAGES, ACTIONS, **{**OPTIONS, "sources": ["above", "left"]}, mode="a", provenance={"seed": 2}
    ) as writer:
        assert (writer.n_episodes, writer.n_steps) == (3, sum(len(episode["actions"]) for episode in episodes))
        episodes.append({**make_episode(3), "source": "above"})
        writer.add_episode(**episodes[-1])
    dataset = OfflineDataset(path)
    assert_holds(dataset, episodes)
    assert dataset.sources == ["left", "right", "above"]
    assert dataset.provenance == {"seed": 1, "appended": [{"seed": 2}]}
    with pytest.raises(DatasetError, match="exists already"):
        DatasetWriter(path, IMAGES, ACTIONS)
    with pytest.raises(DatasetError, match="mode: is 'r'"):
        DatasetWriter(path, IMAGES, ACTIONS, **OPTIONS, mode="r")
    with pytest.raises(DatasetError, match="same arrays"):
        DatasetWriter(path, IMAGES, ACTIONS, mode="a")
    with pytest.raises(DatasetError, match="same spaces"):
        DatasetWriter(path, data_files.STATES, ACTIONS, **OPTIONS, mode="a")
    write_dataset(path, 2, first=5, mode="w")
    assert_holds(OfflineDataset(path), [make_episode(5), make_episode(6)])


def test_a_refused_writer_lets_the_file_go(tmp_path):
    write_dataset(tmp_path / "d.h5", 1)
    with pytest.raises(DatasetError, match="same spaces") as caught:
        DatasetWriter(tmp_path / "d.h5", data_files.STATES, ACTIONS, **OPTIONS, mode="a")
    with DatasetWriter(tmp_path / "d.h5", IMAGES, ACTIONS, **OPTIONS, mode="a") as writer:
        writer.add_episode(**make_episode(1))
    assert caught.value.__traceback__ is not None  # as in an interactive session, which keeps the last error
    assert_holds(OfflineDataset(tmp_path / "d.h5"), [make_episode(0), make_episode(1)])


def test_the_old_file_stays_until_there_is_something_to_replace_it(tmp_path):
    path = tmp_path / "d.h5"
    write_dataset(path, 2)
    with pytest.raises(KeyboardInterrupt), DatasetWriter(path, IMAGES, ACTIONS, **OPTIONS, mode="w"):
        raise KeyboardInterrupt
    assert_holds(OfflineDataset(path), [make_episode(0), make_episode(1)])
    with DatasetWriter(path, IMAGES, ACTIONS, **OPTIONS, mode="w", capacity=(1, 1)) as writer:
        with pytest.raises(DatasetError, match="actions: holds NaN"):
            writer.add_episode(**{**make_episode(5, n=5), "actions": np.full((5, 2), np.nan)})
        assert_holds(OfflineDataset(path), [make_episode(0), make_episode(1)])
        for index in (5, 6):
            writer.add_episode(**make_episode(index))
            assert_holds(OfflineDataset(path), [make_episode(i) for i in range(5, index + 1)])
    written = path.read_bytes()
    path.unlink()
    write_dataset(path, 2, first=5)
    assert written == path.read_bytes()
    DatasetWriter(path, IMAGES, ACTIONS, **OPTIONS, mode="w").close()
    assert OfflineDataset(path).n_episodes == 0 and os.listdir(tmp_path) == ["d.h5"]


def test_reading_while_the_file_is_replaced(tmp_path, monkeypatch):
    with DatasetWriter(tmp_path / "d.h5", IMAGES, ACTIONS, **OPTIONS, capacity=(1, 13)) as writer:
        writer.add_episode(**make_episode(0))

        def read_slowly(file, path):
            writer.add_episode(**make_episode(1))  # outgrows the room: another file, with other offsets
            return read_header(file, path)

        monkeypatch.setattr("sb3_offline.data.native.read_header", read_slowly)
        assert_holds(OfflineDataset(tmp_path / "d.h5"), [make_episode(0)])


def test_one_writer_many_readers(tmp_path):
    with DatasetWriter(tmp_path / "d.h5", IMAGES, ACTIONS, **OPTIONS) as writer:
        writer.add_episode(**make_episode(0))
        assert_holds(OfflineDataset(tmp_path / "d.h5"), [make_episode(0)])
        for mode in ("a", "w"):
            with pytest.raises(DatasetError, match="written by another process"):
                DatasetWriter(tmp_path / "d.h5", IMAGES, ACTIONS, **OPTIONS, mode=mode)
        writer.add_episode(**make_episode(1))
    assert_holds(OfflineDataset(tmp_path / "d.h5"), [make_episode(0), make_episode(1)])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"observations": np.zeros((4, 8, 6, 3), np.uint8)},
            r"observations: has shape \(4, 8, 6, 3\), expected \(6, 8, 6, 3\)",
        ),
        ({"observations": np.zeros((6, 8, 6, 3))}, "observations: has dtype float64, expected uint8.*255"),
        ({"observations": np.full((6, 8, 6, 3), 256)}, r"observations: holds values in \[256, 256\], outside"),
        ({"actions": np.full((5, 2), np.nan)}, "actions: holds NaN or infinity, first in row 0"),
        ({"actions": np.zeros((0, 2))}, "actions: holds no step"),
        ({"rewards": None}, "rewards: is missing"),
        ({"rewards": np.array([0, 0, np.inf, 0, 0])}, "rewards: holds NaN or infinity, first in row 2"),
        ({"success": np.full(5, 0.5)}, "success: holds values other than 0 and 1"),
        ({"terminated": np.ones(5, bool)}, "terminated: is true before the last step.*split"),
        ({"extras": {"qpos": np.zeros((5, 2)), "qvel": np.zeros(5)}}, "extras/qvel: is not an array of this file"),
        ({"source": "above"}, "source: is 'above', the file's sources are"),
        ({"terminated": True}, r"terminated: has shape \(\), expected \(5,\)"),
        ({"terminated": []}, r"terminated: has shape \(0,\), expected \(5,\)"),
        ({"observations": [[1], [2, 3]]}, r"observations: is no array \(.*\). Give rows of one shape"),
        ({"actions": [[1], [2, 3]]}, "actions: is no array"),
        ({"seed": 2**63}, "seed: is 9223372036854775808, not an integer of 64 bits"),
        ({"seed": None}, "seed: is None, not an integer"),
    ],
)
def test_a_bad_episode_is_refused_whole(tmp_path, change, message):
    with DatasetWriter(tmp_path / "d.h5", IMAGES, ACTIONS, **OPTIONS) as writer:
        writer.add_episode(**make_episode(0))
        with pytest.raises(DatasetError, match=message):
            writer.add_episode(**{**make_episode(1, n=5), **change})
        writer.add_episode(**make_episode(2))
    assert_holds(OfflineDataset(tmp_path / "d.h5"), [make_episode(0), make_episode(2)])


def test_an_episode_of_a_file_with_an_empty_list_of_sources_is_refused(tmp_path):
    with DatasetWriter(tmp_path / "d.h5", IMAGES, ACTIONS, **{**OPTIONS, "sources": []}) as writer:
        with pytest.raises(DatasetError, match=r"source: is None, the file's sources are \[\]"):
            writer.add_episode(**{**make_episode(0), "source": None})


@pytest.mark.parametrize(
    "space",
    [
        IMAGES,
        ACTIONS,
        spaces.Box(np.array([-np.inf, 0.1]), np.array([1.0, np.inf]), dtype=np.float64),
        spaces.Discrete(5, start=-1),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary((2, 2)),
        spaces.MultiBinary(3),
        spaces.MultiDiscrete([2, 3], np.int32, start=[1, -1]),
        spaces.Box(0, np.iinfo(np.int64).max, (2,), np.int64),
        spaces.Box(-np.inf, np.inf, (2,), np.int64),
        spaces.Dict({"b": IMAGES, "a": spaces.Discrete(3)}),
    ],
)
def test_spaces_survive_json(space):
    again = space_from_json(space_to_json(space))
    assert again == space and again.dtype == space.dtype
    with pytest.raises(DatasetError, match="cannot be stored"):
        space_to_json(spaces.Tuple([space]))


def test_extras_may_be_text_and_nan(tmp_path):
    extras = {"word": ((), "S5"), "number": ((), np.float32)}
    with DatasetWriter(tmp_path / "d.h5", ACTIONS, ACTIONS, rewards=False, success=False, extras=extras) as writer:
        steps = np.ones((2, 2), np.float32)
        number, word = np.array([np.nan, 1.0]), np.array([b"one", b"three"])
        writer.add_episode(np.ones((3, 2), np.float32), steps, extras={"word": word, "number": number})
        for wrong, message in ((np.array([b"fourteen"] * 2), "room for 5"), (np.array(["a", "b"]), "np.char.encode")):
            with pytest.raises(DatasetError, match=f"extras/word: .*{message}"):
                writer.add_episode(np.ones((3, 2), np.float32), steps, extras={"word": wrong, "number": number})
    dataset = OfflineDataset(tmp_path / "d.h5")
    assert dataset.extras["word"][:].tolist() == word.tolist()
    np.testing.assert_array_equal(dataset.extras["number"], number)
