"""Data of robots and of other offline learners: LeRobot, d3rlpy, pickled trajectories, RLDS, and live objects."""

import pickle
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from data_files import BOTH, write_dataset
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import CallbackList, EveryNTimesteps, ProgressBarCallback
from stable_baselines3.common.vec_env import DummyVecEnv

import sb3_offline
from sb3_offline import BC, DatasetWriter, OfflineDataset
from sb3_offline.cli import main
from sb3_offline.common.stub_env import SpacesOnlyEnv
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import open_datasets

SMALL: dict[str, Any] = {"policy_kwargs": {"net_arch": [4]}, "batch_size": 4, "seed": 0}


def trajectory(index: int, n: int, *, terminated: bool = False, **changes: Any) -> dict[str, Any]:
    """One episode as Decision Transformer keeps it: float64 rewards, observations before and after each step."""
    rng = np.random.default_rng(index)
    rows = rng.normal(size=(n + 1, 3)).astype(np.float32)
    arrays = {
        "observations": rows[:-1],
        "next_observations": rows[1:],
        "actions": rng.uniform(-1, 1, (n, 2)).astype(np.float32),
        "rewards": rng.normal(size=n),
        "terminals": np.arange(n) == (n - 1 if terminated else n),
    }
    return {name: array for name, array in {**arrays, **changes}.items() if array is not None}


# ------------------------------------------------------------ trajectories


@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_pickled_trajectories(tmp_path, protocol):
    given = [trajectory(0, 5, terminated=True), trajectory(1, 3)]
    (tmp_path / "no_suffix").write_bytes(pickle.dumps(given, protocol))
    dataset = OfflineDataset(tmp_path / "no_suffix")
    assert dataset.lengths.tolist() == [5, 3] and dataset.guessed_actions
    assert np.flatnonzero(dataset.terminated).tolist() == [4] and np.flatnonzero(dataset.truncated).tolist() == [7]
    wanted = np.concatenate([np.concatenate([t["observations"], t["next_observations"][-1:]]) for t in given])
    np.testing.assert_array_equal(dataset.observations, wanted)
    np.testing.assert_array_equal(dataset.rewards, np.concatenate([t["rewards"] for t in given]).astype(np.float32))
    np.testing.assert_array_equal(open_datasets(given)[0].observations, wanted)  # a list is one dataset, not several


def test_trajectories_of_other_kinds():
    whole = np.arange(4.0)[:, None]
    (dataset,) = open_datasets(
        [{"observations": {"a": whole, "b": whole + 1}, "actions": whole[1:] / 9, "terminated": [0, 0, 1]}]
    )
    assert dataset.lengths.tolist() == [3] and dataset.terminated.tolist() == [False, False, True]
    np.testing.assert_array_equal(dataset.observations["b"], whole + 1)  # with the last one
    # Without the observations after the steps, an episode that does not terminate loses its last step
    lists = {"observations": whole.tolist(), "actions": (whole / 9).tolist()}
    with pytest.warns(UserWarning, match="terminals: are missing, and so are dones"):
        assert OfflineDataset([lists]).lengths.tolist() == [3]
    with pytest.warns(UserWarning, match="dones: do not tell terminations from time limits"):
        assert OfflineDataset([{**lists, "dones": [0, 0, 0, 1]}]).terminated.tolist() == [False] * 3 + [True]
    limited = OfflineDataset([{**lists, "dones": [0, 1, 0, 1]}, {**lists, "dones": [0, 0, 0, 1]}], max_episode_steps=4)
    assert limited.lengths.tolist() == [2, 2, 3] and limited.terminated.sum() == 2
    one = OfflineDataset([trajectory(0, 3, success=True), trajectory(1, 2, success=False)])
    assert one.success.tolist() == [False, False, True, False, False]
    chosen = OfflineDataset([trajectory(0, 3, actions=np.array([[0], [1], [1]]))], action_space=spaces.Discrete(2))
    assert chosen.actions.tolist() == [0, 1, 1]


class Trap:
    def __reduce__(self):
        return Path.touch, (Path("sprung"),)


def test_unpickling_trajectories_runs_no_code(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for content in ([{**trajectory(0, 3), "infos": Trap()}], [trajectory(0, 3), Trap()]):
        (tmp_path / "t.pkl").write_bytes(pickle.dumps(content))
        with pytest.raises(DatasetError, match=r"trajectories: cannot be unpickled: it holds a .*Path.*load it yourself"):
            OfflineDataset("t.pkl")
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"actions": np.full((3, 2), 1.5)},
            "actions: reaches from .* to 1.5, and data in the format trajectories declare",
        ),
        ({"rewards": np.zeros(2)}, r"trajectory 1: rewards: has shape \(2,\), but there are 3 actions"),
        ({"rewards": None}, "rewards: is missing in trajectory 1, but trajectory 0 has it"),
        ({"observations": np.zeros((2, 3))}, "trajectory 1: observations: has 2 rows, but there are 3 actions"),
        ({"observations": np.zeros((3, 4)), "next_observations": np.zeros((3, 4))}, r"observations: has rows of different"),
        ({"terminals": np.array([0, 0, 7])}, "terminals: holds values other than 0 and 1"),
    ],
)
def test_bad_trajectories(changes, message):
    with pytest.raises(DatasetError, match=message):
        OfflineDataset([trajectory(0, 4), trajectory(1, 3, **changes)])


def test_a_damaged_pickle(tmp_path):
    whole = pickle.dumps([trajectory(0, 200), trajectory(1, 200)])
    (tmp_path / "t.pkl").write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(DatasetError, match=r"t\.pkl: trajectories: cannot be unpickled"):
        OfflineDataset(tmp_path / "t.pkl")


# ------------------------------------------------------------------ d3rlpy


def test_d3rlpy(tmp_path):
    d3rlpy = pytest.importorskip("d3rlpy")
    given = [trajectory(0, 5, terminated=True), trajectory(1, 4)]
    episodes = [
        d3rlpy.dataset.Episode(
            t["observations"], t["actions"], t["rewards"][:, None].astype(np.float32), bool(t["terminals"][-1])
        )
        for t in given
    ]
    buffer = d3rlpy.dataset.ReplayBuffer(d3rlpy.dataset.InfiniteBuffer(), episodes=episodes)
    with open(tmp_path / "renamed.bin", "w+b") as file:
        buffer.dump(file)
    dataset = OfflineDataset(tmp_path / "renamed.bin")
    # d3rlpy itself makes 5 and 3 transitions of these episodes
    assert dataset.lengths.tolist() == [5, 3] == [episode.transition_count for episode in buffer.episodes]
    assert np.flatnonzero(dataset.terminated).tolist() == [4] and np.flatnonzero(dataset.truncated).tolist() == [7]
    np.testing.assert_array_equal(dataset.actions, np.concatenate([given[0]["actions"], given[1]["actions"][:3]]))
    np.testing.assert_array_equal(dataset.observations[6:], given[1]["observations"])
    with h5py.File(tmp_path / "renamed.bin", "r+") as file:
        del file["actions_1"]
    with pytest.raises(DatasetError, match=r"renamed\.bin: actions_1: is missing, but num_episodes is 2"):
        OfflineDataset(tmp_path / "renamed.bin")


def test_d3rlpy_of_version_1_and_tuples(tmp_path):
    one = trajectory(0, 6)
    with h5py.File(tmp_path / "old.h5", "w") as file:
        file.update({name: one[name] for name in ("observations", "actions", "rewards")})
        file.update(
            {"terminals": np.arange(6) == 2, "episode_terminals": np.isin(np.arange(6), (2, 5)), "discrete_action": False}
        )
    old = OfflineDataset(tmp_path / "old.h5")
    assert old.provenance["format"] == "d3rlpy" and old.lengths.tolist() == [3, 2]
    with h5py.File(tmp_path / "tuple.h5", "w") as file:
        file.update({"columns": ["observations", "actions", "rewards", "terminated"], "num_episodes": 1, "terminated_0": True})
        file.update({"observations_0_0": one["observations"], "observations_0_1": np.zeros((6, 4, 4, 3), np.uint8)})
        file.update({"actions_0": one["actions"], "rewards_0": one["rewards"]})
    space = OfflineDataset(tmp_path / "tuple.h5").observation_space
    assert space["0"].shape == (3,) and space["1"] == spaces.Box(0, 255, (4, 4, 3), np.uint8)


# -------------------------------------------------------------------- RLDS


def test_rlds_is_refused_with_the_way_to_convert(tmp_path):
    version = tmp_path / "bridge" / "1.0.0"
    version.mkdir(parents=True)
    for name in ("dataset_info.json", "features.json"):
        (version / name).write_text("{}")
    record = version / "bridge-train.tfrecord-00000-of-00001"
    record.write_bytes(b"\x10\x00\x00\x00\x00\x00\x00\x00")
    for path in (version, version.parent, record):
        with pytest.raises(DatasetError, match=r"is RLDS .*DatasetWriter: for each episode of tfds"):
            OfflineDataset(path)


# ------------------------------------------------------------ live objects


def live_objects() -> dict[str, Any]:
    buffer = ReplayBuffer(20, spaces.Box(-9, 9, (3,)), spaces.Box(-1, 1, (2,)))
    one = trajectory(0, 8, terminated=True)
    for step in range(8):
        parts = [one[name][step][None] for name in ("observations", "next_observations", "actions", "rewards", "terminals")]
        buffer.add(*parts, [{}])
    return {"buffer": buffer, "dict": one, "list": [one], "dataset": OfflineDataset([one])}


@pytest.mark.parametrize("kind", ["buffer", "dict", "list", "dataset"])
def test_a_model_learns_from_live_objects_and_is_saved_without_them(tmp_path, kind):
    given = live_objects()[kind]
    model = BC("MlpPolicy", None, dataset=given, **SMALL).learn(2)
    model.save(tmp_path / "model.zip")
    loaded = BC.load(tmp_path / "model.zip")
    assert loaded.dataset is None
    loaded.dataset = given
    assert loaded.learn(1).replay_buffer.size() == 8
    model.dataset = ["a.h5", given]
    assert "dataset" in model._excluded_save_params()
    model.dataset = ["a.h5", Path("b.h5")]
    assert "dataset" not in model._excluded_save_params()


def test_a_minari_dataset_in_memory(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    write_dataset(tmp_path / "d.h5", 4, BOTH)
    main(["convert", str(tmp_path / "d.h5"), "minari:test/there-v0"])
    theirs = minari.load_dataset("test/there-v0")
    (whole,) = open_datasets(theirs)
    np.testing.assert_array_equal(whole.actions, OfflineDataset(tmp_path / "d.h5").actions)
    (chosen,) = open_datasets(theirs.filter_episodes(lambda episode: episode.id in (1, 3)))
    np.testing.assert_array_equal(chosen.lengths, whole.lengths[[1, 3]])


@pytest.mark.parametrize("given", [42, object(), np.zeros((3, 2)), {"obs": 1}, [3.5], lambda: 1])
def test_other_objects_are_refused_by_their_type_with_the_ways_in(given):
    inner = given[0] if isinstance(given, list) else given
    with pytest.raises(DatasetError, match=rf"<{type(inner).__name__}>: object: .*{type(inner).__qualname__}.*") as caught:
        BC("MlpPolicy", None, dataset=given, **SMALL)
    for way in (
        "a path",
        "OfflineDataset",
        "ReplayBuffer",
        "MinariDataset",
        "D4RL's names",
        "trajectory dicts",
        "DatasetWriter",
    ):
        assert way in caught.value.remedy


def test_the_doors_are_at_the_top():
    assert sb3_offline.DatasetWriter is DatasetWriter and set(sb3_offline.ALGOS) == {
        c.__module__.split(".")[1] for c in sb3_offline.ALGOS.values()
    }


@pytest.mark.parametrize("nested", [False, True])
def test_bars_of_sb3_count_gradient_steps(nested):
    bar = ProgressBarCallback()
    callback = CallbackList([EveryNTimesteps(2, CallbackList([])), bar]) if nested else bar
    env = DummyVecEnv([lambda: SpacesOnlyEnv(spaces.Box(-np.inf, np.inf, (3,)), spaces.Box(-1, 1, (2,)))] * 4)
    model = BC("MlpPolicy", env, dataset=[trajectory(0, 8)], **SMALL).learn(5, callback=callback)
    assert bar.pbar.n == 5 == bar.pbar.total
    model.learn(3, callback=callback, reset_num_timesteps=False)
    assert bar.pbar.n == 3


# ----------------------------------------------------------------- LeRobot
