"""Data of other libraries are read without loss, and are written as Minari datasets without loss."""

import pickle
import shutil
import sys
from fractions import Fraction
from pathlib import Path

import gymnasium as gym
import h5py
import numpy as np
import pytest
from data_files import ACTIONS, BOTH, OPTIONS, STATES, make_episode, write_dataset
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env

from sb3_offline import BC
from sb3_offline.cli import main
from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.convert import convert
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.foreign import registry
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.reader import OfflineDataset, open_datasets
from sb3_offline.data.writer import DatasetWriter

ROLLOUTS = Path(__file__).parent / "files" / "imitation_rollouts"


def assert_same(one: OfflineDataset, other: OfflineDataset):
    """All arrays and attributes are equal, apart from what Minari adds to the provenance."""
    assert one.arrays.keys() == other.arrays.keys()
    for name, array in one.arrays.items():
        array, copy = np.asarray(array), np.asarray(other.arrays[name])
        assert array.dtype == copy.dtype, name
        np.testing.assert_array_equal(array, copy, err_msg=name)
    for name in ("observation_space", "action_space", "env_id", "env_kwargs", "sources"):
        assert getattr(one, name) == getattr(other, name), name
    assert one.provenance == {key: value for key, value in other.provenance.items() if key != "minari"}


# ----------------------------------------------------------------- formats


def d4rl_arrays():
    return {
        "observations": np.arange(5, dtype=np.float32)[:, None],
        "actions": np.zeros((5, 1), np.float32),
        "rewards": np.arange(5.0),
        "terminals": np.arange(5) == 4,
    }


@pytest.fixture
def samples(tmp_path):
    """A path of each format, by the format's name."""
    collect(tmp_path / "buffer.pkl", 10)
    np.savez(tmp_path / "rollouts.npz", **rollouts(acts=np.zeros((5, 1), np.float32)))
    with h5py.File(tmp_path / "d4rl.hdf5", "w") as file:
        file.update(d4rl_arrays())
    write_dataset(tmp_path / "native.h5", 2)
    names = {"Stable-Baselines3": "buffer.pkl", "imitation": "rollouts.npz", "D4RL": "d4rl.hdf5", "native": "native.h5"}
    return {format_name: tmp_path / name for format_name, name in names.items()}


@pytest.mark.filterwarnings("ignore:.*timeouts. are missing")
def test_formats_are_recognised_by_their_contents(samples, tmp_path):
    for format_name, path in samples.items():
        with Probe(path) as probe:
            recognizing = [known.name for known in registry.known_formats() if known.recognizes(probe)]
        assert recognizing == ([] if format_name == "native" else [format_name])
        for name in ("no_suffix", "wrong.pkl", "wrong.h5"):
            shutil.copy(path, tmp_path / name)
            assert_same(OfflineDataset(path), OfflineDataset(tmp_path / name))


def test_a_dict_of_arrays(samples):
    (dataset,) = open_datasets(d4rl_arrays() | {"next_observations": np.arange(1, 6, dtype=np.float32)[:, None]})
    assert dataset.lengths.tolist() == [5] and dataset.observations[:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    with pytest.raises(DatasetError, match="<dict>: rewards: has 4 rows, but actions has 5"):
        OfflineDataset(d4rl_arrays() | {"rewards": np.zeros(4)})


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "file: .* an empty file"),
        (b"<html>404</html>", "neither HDF5, nor a zip archive, nor a pickle, but begins with b'<html>404</html>'"),
        (b"PK\x03\x04 and no more", "an empty or damaged zip archive"),
        (pickle.dumps([{"observations": np.zeros(3)}]), "a pickle with an object of type list"),
        (pickle.dumps({"a": 1}, protocol=2), "a pickle with an object of type dict"),
        (pickle.dumps(np.zeros(3)), r"a pickle with an object of type numpy\..*"),
        (["a.npz", "b.npz"], r"folder: .* a folder with a\.npz, b\.npz\. Give a file or a pattern"),
        ([], "an empty folder"),
        (42, "<int>: object: .* an object of type builtins.int"),
        ({"obs": 1}, "<dict>: object: .* an object of type builtins.dict with the keys obs"),
    ],
)
def test_what_has_no_known_format_is_described(tmp_path, content, found):
    given = tmp_path / "x.bin"
    if isinstance(content, bytes):
        given.write_bytes(content)
    elif isinstance(content, list):
        given.mkdir()
        for name in content:
            (given / name).touch()
    else:
        given = content
    with pytest.raises(DatasetError, match=found) as caught:
        open_datasets(given)
    for name in ("sb3-offline", "D4RL", "imitation", "Minari", "Stable-Baselines3"):
        assert f"{name} (" in caught.value.remedy


TOY_FORMAT = """
import numpy as np
from gymnasium import spaces
from sb3_offline.data.foreign.base import Foreign, Format
from sb3_offline.data.foreign.d4rl import read as read_d4rl

def recognizes(probe):
    return "qpos" in probe.names

def read(probe, options):
    header, arrays = read_d4rl(probe, options)
    header.provenance = {"format": "toy", "limit": options.max_episode_steps}
    return Foreign(header, arrays)

FORMAT = Format("toy", "an HDF5 file with qpos", recognizes, read, declares_spaces=False, refines=REFINES)
"""


@pytest.mark.filterwarnings("ignore:.*timeouts. are missing")
def test_a_format_is_added_by_one_module(samples, tmp_path, monkeypatch):
    (tmp_path / "formats").mkdir()
    with h5py.File(samples["D4RL"], "r+") as file:
        file["qpos"] = np.zeros((5, 2))
    monkeypatch.setattr(registry.folder, "__path__", [*registry.folder.__path__, str(tmp_path / "formats")])
    try:
        for module, refines in (("toy_one", "()"), ("toy_two", "('D4RL',)")):
            (tmp_path / "formats" / f"{module}.py").write_text(TOY_FORMAT.replace("REFINES", refines))
            registry.known_formats.cache_clear()
            if refines == "()":
                with pytest.raises(DatasetError, match="format: may have any of the formats D4RL, toy"):
                    OfflineDataset(samples["D4RL"])
                (tmp_path / "formats" / f"{module}.py").unlink()
        dataset = OfflineDataset(samples["D4RL"], max_episode_steps=5)
        assert dataset.provenance == {"format": "toy", "limit": 5} and dataset.guessed_actions
    finally:
        registry.known_formats.cache_clear()


# ------------------------------------------------------------------ Minari


@pytest.fixture
def minari(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return pytest.importorskip("minari")


@pytest.mark.parametrize(
    ("space", "options"),
    [
        (STATES, {"provenance": {"seed": 1}, "env_id": "Pendulum-v1", "env_kwargs": {"g": 9.0}}),
        (BOTH, {}),
        (spaces.Box(0, 255, (40, 36, 3), np.uint8), {"env_id": "Unknown-v0"}),  # large enough for Minari to call it an image
        (STATES, {"rewards": False, "success": False}),
    ],
)
def test_to_minari_and_back(minari, tmp_path, space, options):
    left_out = [name for name in ("rewards", "success") if options.get(name) is False]
    with DatasetWriter(tmp_path / "d.h5", space, ACTIONS, **OPTIONS, **options) as writer:
        for index in range(4):
            writer.add_episode(**{k: v for k, v in make_episode(index, space).items() if k not in left_out})
    main(["convert", str(tmp_path / "d.h5"), "minari:test/there-v0"])
    theirs = minari.load_dataset("test/there-v0")
    assert theirs.total_episodes == 4 and theirs.observation_space == space
    if options.get("env_id") == "Pendulum-v1":
        assert theirs.recover_environment().unwrapped.g == 9.0
    if space is not BOTH:
        np.testing.assert_array_equal(theirs[1].observations, make_episode(1, space)["observations"])
    main(["convert", "minari:test/there-v0", str(tmp_path / "back.h5"), "--storage", "compressed"])
    assert_same(OfflineDataset(tmp_path / "d.h5"), OfflineDataset(tmp_path / "back.h5"))
    if not options:
        dataset = OfflineDataset(tmp_path / "d.h5")
        dataset.header.env_id = "Pendulum-v1"  # as --env does for data that declare none
        convert(dataset, "minari:test/named-v0")
        assert OfflineDataset("minari:test/named-v0").env_id == "Pendulum-v1"


def test_from_minari_and_back(minari, tmp_path):
    """A dataset that Minari wrote: float64 rewards and actions, nested infos with a row of the reset, texts, options."""
    from minari.data_collector.episode_buffer import EpisodeBuffer

    space, actions = spaces.Dict({"x": spaces.Box(-9, 9, (2,), np.float64)}), spaces.Box(-1, 1, (1,), np.float64)
    rng = np.random.default_rng(0)
    buffers = []
    for index, n in enumerate((4, 2)):
        infos = {
            "success": np.arange(n + 1) > 2,
            "state": {"qpos": rng.normal(size=(n + 1, 3)), "a.b": np.zeros(n + 1)},
            "stage": [f"stage {t}" for t in range(n + 1)],
            "state.qpos": rng.normal(size=n + 1),
            "reset.late": rng.normal(size=n),
            "late": rng.normal(size=n),
        }
        buffers.append(
            EpisodeBuffer(
                seed=7 if index else None,
                options={"start": [1.0, 2.0]} if index else None,
                observations={"x": rng.normal(size=(n + 1, 2))},
                actions=rng.uniform(-1, 1, (n, 1)),
                rewards=rng.normal(size=n),
                terminations=np.arange(n) == (n - 1 if index else n),
                truncations=np.arange(n) == (n - 1 if not index else n),
                infos=infos,
            )
        )
    made = minari.create_dataset_from_buffers(
        "test/here-v3",
        buffers,
        env="CartPole-v1",
        eval_env="CartPole-v1",
        observation_space=space,
        action_space=actions,
        author={"A. Person"},
        author_email={"a@b.c"},
        code_permalink="there",
        algorithm_name="random",
        description="words",
    )
    main(["convert", "minari:test/here-v3", str(tmp_path / "d.h5")])
    ours = OfflineDataset(tmp_path / "d.h5")
    assert (
        ours.env_id == "CartPole-v1"
        and ours.seeds.tolist() == [-1, 7]
        and ours.success.tolist() == [False] * 2 + [True] * 2 + [False] * 2
    )
    np.testing.assert_array_equal(ours.extras["state.qpos"], np.concatenate([b.infos["state"]["qpos"][1:] for b in buffers]))
    main(["convert", str(tmp_path / "d.h5"), "minari:test/here-v4"])
    copy = minari.load_dataset("test/here-v4")
    for one, two in zip(made, copy, strict=True):
        for name in ("rewards", "actions", "terminations", "truncations"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name), err_msg=name)
            assert getattr(one, name).dtype == getattr(two, name).dtype
        np.testing.assert_array_equal(one.observations["x"], two.observations["x"])
        np.testing.assert_equal(one.infos, two.infos)
    for one, two in zip(*(d.storage.get_episode_metadata([0, 1]) for d in (made, copy)), strict=True):
        np.testing.assert_equal(one, two)
    changed = {name for name, value in made.storage.metadata.items() if copy.storage.metadata.get(name) != value}
    assert changed - {"dataset_size"} == {"dataset_id", "jpeg_encoding"}


def test_minari_mistakes_are_named(minari, tmp_path):
    with pytest.raises(DatasetError, match=r"minari:nothing: name: is no ID"):
        OfflineDataset("minari:nothing")
    with pytest.raises(DatasetError, match=r"dataset: does not exist\. .*: minari download mujoco/hopper/medium-v0"):
        OfflineDataset("minari:mujoco/hopper/medium-v0")
    with pytest.raises(
        DatasetError, match=r"file: does not exist.* give minari:mujoco/hopper/medium-v0 for a dataset of Minari"
    ):
        open_datasets("mujoco/hopper/medium-v0")
    write_dataset(tmp_path / "d.h5", 2, STATES)
    main(["convert", str(tmp_path / "d.h5"), "minari:there-v0"])
    with pytest.raises(SystemExit, match=r"exists already\. Give another name or version"):
        main(["convert", str(tmp_path / "d.h5"), "minari:there-v0"])
    there = tmp_path / "minari" / "there-v0"
    for inside in (there, there / "data", there / "data" / "main_data.hdf5"):
        assert_same(OfflineDataset(tmp_path / "d.h5"), OfflineDataset(inside))


def test_the_extra_that_is_missing_is_named(tmp_path, monkeypatch):
    write_dataset(tmp_path / "d.h5", 1)
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(DatasetError, match=r'Minari needs the package minari\. Install it with: .*"sb3-offline\[minari\]"'):
        convert(tmp_path / "d.h5", "minari:test/there-v0")


# ---------------------------------------------------------- replay buffers


class Walk(gym.Env):
    """Terminates now and then; no two observations are equal."""

    action_space = ACTIONS

    def __init__(self, as_dict=False):
        box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.observation_space = spaces.Dict({"state": box, "one": spaces.Discrete(3)}) if as_dict else box

    def observe(self):
        state = self.np_random.normal(size=2).astype(np.float32)
        return {"state": state, "one": 1} if isinstance(self.observation_space, spaces.Dict) else state

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observe(), {}

    def step(self, action):
        reward = float(action.sum())
        return self.observe(), reward, bool(self.np_random.random() < 0.15), False, {}


def collect(path, n_steps, as_dict=False, learn_twice=False, **kwargs):
    env = make_vec_env(
        Walk,
        n_envs=3,
        seed=0,
        env_kwargs={"as_dict": as_dict},
        wrapper_class=gym.wrappers.TimeLimit,
        wrapper_kwargs={"max_episode_steps": 6},
    )
    policy = "MultiInputPolicy" if as_dict else "MlpPolicy"
    model = SAC(policy, env, learning_starts=10**6, seed=0, policy_kwargs={"net_arch": [4]}, **kwargs).learn(n_steps)
    if learn_twice:
        model.learn(n_steps)
    model.save_replay_buffer(path)
    return model.replay_buffer


def transitions_of(buffer, steps):
    """End, action, reward, observation and next observation at each (place, environment), sorted."""
    rows = []
    for place, env in steps:
        done = buffer.dones[place, env] * (1 - buffer.timeouts[place, env])
        row = [[done], buffer.actions[place, env], [buffer.rewards[place, env]]]
        for x in (buffer.observations, buffer.next_observations):
            row += [part[place, env].ravel() for part in (x.values() if isinstance(x, dict) else [x])]
        rows.append(np.concatenate(row))
    return np.array(sorted(map(tuple, rows)))


def dataset_transitions(dataset):
    buffer = OfflineReplayBuffer(dataset, dataset.observation_space, dataset.action_space)
    batch = buffer.transitions(np.arange(buffer.size()))
    parts = [batch.dones, batch.actions, batch.rewards]
    for x in (batch.observations, batch.next_observations):
        parts += list(x.values()) if isinstance(x, dict) else [x]
    rows = np.concatenate([np.asarray(part).reshape(buffer.size(), -1) for part in parts], axis=1)
    return np.array(sorted(map(tuple, rows)))


@pytest.mark.parametrize(
    ("as_dict", "buffer_size", "learn_twice"),
    [(False, 1000, False), (False, 90, False), (True, 90, False), (False, 1000, True)],
)
def test_every_transition_of_a_replay_buffer_is_there(tmp_path, as_dict, buffer_size, learn_twice):
    buffer = collect(tmp_path / "b.pkl", 150, as_dict, learn_twice, buffer_size=buffer_size)
    main(["convert", str(tmp_path / "b.pkl"), str(tmp_path / "d.h5")])
    dataset = OfflineDataset(tmp_path / "d.h5")
    steps = [(place, env) for place in range(buffer.size()) for env in range(3)]
    assert dataset.n_steps == len(steps)
    np.testing.assert_allclose(dataset_transitions(dataset), transitions_of(buffer, steps), atol=1e-5)
    assert dataset.truncated.sum() == buffer.timeouts[: buffer.size()].sum() > 0 and dataset.lengths.max() <= 6


@pytest.mark.parametrize("buffer_size", [1000, 90])
def test_a_buffer_of_half_the_memory(tmp_path, buffer_size):
    """Such a buffer overwrites the last observations of episodes, and does not tell which ends were time limits."""
    kwargs = {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}}
    buffer = collect(tmp_path / "b.pkl", 150, buffer_size=buffer_size, **kwargs)
    steps = [(p, e) for p in range(buffer.size()) for e in range(3) if not (buffer.full and p == buffer.pos)]
    buffer.next_observations = np.roll(buffer.observations, -1, axis=0)
    wanted, everything = transitions_of(buffer, steps), OfflineDataset(tmp_path / "b.pkl")
    assert everything.n_steps == len(steps) and not everything.truncated.any()
    inside = slice(None, int((wanted[:, 0] == 0).sum()))
    np.testing.assert_allclose(dataset_transitions(everything)[inside], wanted[inside], atol=1e-5)
    limited = OfflineDataset(tmp_path / "b.pkl", max_episode_steps=6)
    lengths = limited.lengths[limited.truncated[limited.step_starts + limited.lengths - 1]]
    assert len(lengths) > 5 and set(lengths) <= {5, 6}  # most episodes lose their last step
    assert limited.n_steps == len(steps) - (lengths == 5).sum()


def test_replay_buffers_in_memory_and_of_old_versions(tmp_path):
    buffer = collect(tmp_path / "b.pkl", 150)
    saved, (alive,) = OfflineDataset(tmp_path / "b.pkl"), open_datasets(buffer)
    assert_same(saved, alive)
    assert_same(saved.select([2, 0]), pickle.loads(pickle.dumps(alive)).select([2, 0]))
    del buffer.timeouts, buffer.handle_timeout_termination
    old = OfflineDataset(buffer)
    assert old.n_steps == saved.n_steps and not old.truncated.any()
    limited = OfflineDataset(buffer, max_episode_steps=6)
    last = limited.step_starts + limited.lengths - 1
    assert saved.truncated.any() and limited.truncated[saved.truncated].all()
    assert set(limited.lengths[limited.truncated[last]]) == {6}


def test_pickles_without_a_replay_buffer_are_refused(tmp_path):
    whole = pickle.dumps(Fraction(1, 2))
    damaged = "file: cannot be unpickled"
    for name, content, untrusted, message in (
        ("a.pkl", whole, r"may run any code .*it calls fractions.Fraction", "is a fractions.Fraction, not a ReplayBuffer"),
        ("b.pkl", whole[:-10], f"{damaged}|may run any code", damaged),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DatasetError, match=untrusted):
            OfflineDataset(tmp_path / name)
        with pytest.raises(DatasetError, match=message):
            OfflineDataset(tmp_path / name, trust=True)
    with pytest.raises(DatasetError, match="does not exist"):
        OfflineDataset(tmp_path / "nowhere.pkl")


# -------------------------------------------------------------- imitation


def rollouts(**changes):
    """Two episodes of 3 and 2 steps, as imitation 1.0.1 and older wrote them."""
    rng = np.random.default_rng(0)
    arrays = {
        "obs": rng.normal(size=(7, 2)).astype(np.float32),
        "acts": rng.uniform(-2, 2, (5, 1)).astype(np.float32),
        "infos": np.array([{}] * 5, dtype=object),
        "terminal": np.array([True, True]),
        "indices": np.array([3]),
        "rews": rng.normal(size=5),
    }
    return {**arrays, **changes}


def test_rollouts_of_imitation(tmp_path):
    np.savez(tmp_path / "r.npz", **rollouts())
    dataset = OfflineDataset(tmp_path / "r.npz", action_space=spaces.Box(-2, 2, (1,)), max_episode_steps=3)
    assert dataset.lengths.tolist() == [3, 2] and dataset.truncated.tolist() == [False, False, True, False, False]
    assert dataset.terminated.tolist() == [False] * 4 + [True]
    for name, theirs in (("observations", "obs"), ("actions", "acts"), ("rewards", "rews")):
        np.testing.assert_array_equal(dataset.arrays[name], rollouts()[theirs].astype(np.float32))


def test_rollouts_in_a_folder_say_which_episodes_were_cut():
    pytest.importorskip("pyarrow")
    dataset = OfflineDataset(ROLLOUTS)
    assert dataset.lengths.tolist() == [3, 5, 2] and dataset.actions.shape == (10, 1)
    last = dataset.step_starts + dataset.lengths - 1
    assert dataset.terminated[last].tolist() == [True, False, False] and dataset.truncated[last].tolist() == [
        False,
        True,
        False,
    ]
    np.testing.assert_allclose(dataset.observations[4], [-1.245911, -0.7322674])  # the first of the second episode
    np.testing.assert_allclose(
        np.add.reduceat(dataset.rewards, dataset.step_starts), [-2.5024965, 0.7424768, -0.0494672], rtol=1e-5
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, r"actions: reaches from .* declare no bounds. Open it with OfflineDataset\(path, action_space="),
        ({"acts": np.zeros(5, np.int64)}, "actions: has dtype int64"),
        ({"obs": np.zeros((6, 2), np.float32)}, "obs: has 6 rows, expected 7 for 5 actions in 2 episodes"),
        ({"indices": np.array([5])}, "indices: holds an episode without a step"),
    ],
)
def test_bad_rollouts(tmp_path, changes, message):
    np.savez(tmp_path / "r.npz", **rollouts(**changes))
    with pytest.raises(DatasetError, match=message):
        OfflineDataset(tmp_path / "r.npz")
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    with pytest.raises(DatasetError, match=r"no known format: it is a zip archive .* with x.*obs, acts, terminal, indices"):
        OfflineDataset(tmp_path / "other.npz")


def test_discrete_actions_are_refused_by_name(tmp_path):
    np.savez(tmp_path / "r.npz", **rollouts(acts=np.zeros(5, np.int64), obs=np.zeros((7, 4), np.float32)))
    main(["convert", str(tmp_path / "r.npz"), str(tmp_path / "cartpole.h5"), "--env", "CartPole-v1"])
    dataset = OfflineDataset(tmp_path / "cartpole.h5")
    assert dataset.action_space == spaces.Discrete(2) and dataset.env_id == "CartPole-v1"
    with pytest.raises(DatasetError, match=r"is Discrete\(2\), but BC learns continuous actions \(Box\)"):
        BC("MlpPolicy", "CartPole-v1", dataset)
    with pytest.raises(
        SystemExit, match=r"cartpole.h5: action_space: is Discrete\(2\), but BC learns continuous actions \(Box\)"
    ):
        main(
            ["train", "--algo", "bc", "--env", "CartPole-v1", "--dataset", str(tmp_path / "cartpole.h5"), "-o", str(tmp_path)]
        )
