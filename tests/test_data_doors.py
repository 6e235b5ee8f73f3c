"""Data of other libraries come in whole, and go out to Minari whole."""

import pickle
from pathlib import Path

import gymnasium as gym
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
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter

ROLLOUTS = Path(__file__).parent / "files" / "imitation_rollouts"


def assert_same(one: OfflineDataset, other: OfflineDataset):
    """All arrays and attributes are equal, but for what Minari added to the provenance."""
    assert one.arrays.keys() == other.arrays.keys()
    for name, array in one.arrays.items():
        array, copy = np.asarray(array), np.asarray(other.arrays[name])
        assert array.dtype == copy.dtype, name
        np.testing.assert_array_equal(array, copy, err_msg=name)
    for name in ("observation_space", "action_space", "env_id", "env_kwargs", "sources"):
        assert getattr(one, name) == getattr(other, name), name
    assert one.provenance == {key: value for key, value in other.provenance.items() if key != "minari"}


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
        dataset.header.env_id = "Pendulum-v1"  # as --env does where a source declares none
        convert(dataset, "minari:test/named-v0")
        assert OfflineDataset("minari:test/named-v0").env_id == "Pendulum-v1"


def test_from_minari_and_back(minari, tmp_path):
    """What Minari's own functions wrote: float64 rewards and actions, nested infos with a row of the reset, texts, options."""
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


def test_minari_mistakes_are_named(minari, tmp_path, capsys):
    with pytest.raises(DatasetError, match=r"minari:nothing: name: is no id"):
        OfflineDataset("minari:nothing")
    with pytest.raises(DatasetError, match="file: does not exist"):
        OfflineDataset("minari:nothing/there-v0")
    write_dataset(tmp_path / "d.h5", 2, STATES)
    main(["convert", str(tmp_path / "d.h5"), "minari:there-v0"])
    with pytest.raises(SystemExit, match=r"exists already\. Give another name or version"):
        main(["convert", str(tmp_path / "d.h5"), "minari:there-v0"])
    with pytest.raises(DatasetError, match="is neither a Minari dataset nor"):
        OfflineDataset(tmp_path)


# ---------------------------------------------------------- replay buffers


class Walk(gym.Env):
    """Terminates now and then; every observation is another one."""

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
    """Of each (place, environment), sorted: end, observation, action, reward and next observation."""
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
    """It overwrites the observations that episodes end with, and does not say which ends were time limits."""
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
    assert len(lengths) > 5 and set(lengths) <= {5, 6}  # the last step led nobody knows where, but for the newest
    assert limited.n_steps == len(steps) - (lengths == 5).sum()


def test_what_is_no_replay_buffer_is_named(tmp_path):
    for name, content, message in (
        ("a.pkl", b"not a pickle", "cannot be unpickled"),
        ("b.pkl", pickle.dumps({"a": 1}), r"holds a builtins.dict, no ReplayBuffer"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DatasetError, match=message):
            OfflineDataset(tmp_path / name)
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
        ({}, r"actions: reaches from .* declares no bounds. Open it with OfflineDataset\(path, action_space="),
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
    with pytest.raises(DatasetError, match="obs: is missing"):
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
