"""Files of robomimic, ManiSkill, OGBench, DMC/ExORL/V-D4RL and ALOHA open with the numbers that their own loaders give."""

import shutil
import warnings

import h5py
import numpy as np
import pytest
from format_files import (
    LENGTHS,
    dmc_episode,
    images,
    ogbench_arrays,
    ogbench_loader,
    rng,
    write_aloha,
    write_dmc,
    write_maniskill,
    write_robomimic,
)
from gymnasium import spaces

from sb3_offline import BC
from sb3_offline.cli import main
from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.foreign import registry
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.reader import OfflineDataset, open_datasets
from sb3_offline.data.selection import select_episodes

JOINTS = spaces.Box(-9, 9, (3,), np.float32)


def transitions(dataset):
    """(observations, actions, next observations), each with one row for each step."""
    rows = np.arange(dataset.n_steps) + np.repeat(np.arange(dataset.n_episodes), dataset.lengths)
    observations = dataset.observations
    if isinstance(observations, dict):
        return (
            {k: a[rows] for k, a in observations.items()},
            dataset.actions,
            {k: a[rows + 1] for k, a in observations.items()},
        )
    return observations[rows], dataset.actions, observations[rows + 1]


# --------------------------------------------------------------- robomimic


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_robomimic(tmp_path, dtype):
    demos = write_robomimic(tmp_path / "demo.h5", dtype=dtype)
    dataset = OfflineDataset(tmp_path / "demo.h5")
    assert dataset.lengths.tolist() == list(LENGTHS) and dataset.guessed_actions and dataset.success is None
    before, actions, after = transitions(dataset)
    for key in ("eef_pos", "agentview_image"):
        for rows, name in ((before, "obs"), (after, "next_obs")):
            expected = np.concatenate([demo[f"{name}/{key}"] for demo in demos])
            np.testing.assert_array_equal(rows[key], expected.astype(rows[key].dtype))
    np.testing.assert_array_equal(actions, np.concatenate([demo["actions"] for demo in demos]).astype(np.float32))
    np.testing.assert_array_equal(dataset.rewards, np.concatenate([demo["rewards"] for demo in demos]))
    np.testing.assert_array_equal(dataset.extras["states"], np.concatenate([demo["states"] for demo in demos]))
    np.testing.assert_array_equal(dataset.terminated, np.concatenate([demo["dones"] for demo in demos]))
    assert not dataset.truncated.any()
    assert dataset.observation_space["agentview_image"] == spaces.Box(0, 255, (6, 7, 3), np.uint8)
    assert dataset.provenance["robomimic"]["env_args"]["env_name"] == "Lift"
    (valid,) = select_episodes(dataset, source="valid")
    assert valid.lengths.tolist() == [LENGTHS[1]]
    assert dataset.extras["mask.better"].sum() == LENGTHS[0]
    main(["convert", str(tmp_path / "demo.h5"), str(tmp_path / "native.h5")])
    np.testing.assert_array_equal(OfflineDataset(tmp_path / "native.h5").actions, actions)


def test_robomimic_without_optional_arrays(tmp_path):
    """LIBERO has no next_obs. Keys are chosen by the space."""
    path = tmp_path / "demo.hdf5"
    write_robomimic(path, next_obs=False)
    dataset = OfflineDataset(path)
    last = dataset.observation_starts[1] - 1
    assert dataset.lengths.tolist() == list(LENGTHS) and dataset.terminated.sum() == 3
    np.testing.assert_array_equal(dataset.observations["eef_pos"][last], dataset.observations["eef_pos"][last - 1])
    write_robomimic(path, next_obs=False, dones=None, rewards=None, states=None)
    dataset = OfflineDataset(path, observation_space=spaces.Dict({"eef_pos": spaces.Box(-9, 9, (3,), np.float32)}))
    assert dataset.lengths.tolist() == [n - 1 for n in LENGTHS] and dataset.rewards is None
    assert list(dataset.observations) == ["eef_pos"]
    assert not dataset.terminated.any() and not dataset.truncated.any()


def test_robomimic_tells_failure_from_termination(tmp_path):
    path = tmp_path / "demo.hdf5"
    write_robomimic(path, rewards=np.zeros(9))
    dataset = OfflineDataset(path)
    assert not dataset.terminated.any() and dataset.truncated.sum() == 3
    write_robomimic(path)
    dataset = OfflineDataset(path, max_episode_steps=5)
    assert dataset.terminated.sum() == 2 and dataset.truncated.tolist().index(True) == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f["data/demo_1"].pop("obs"), r"data/demo_1/obs: is missing.*dataset_states_to_obs"),
        (lambda f: f["data/demo_1"].pop("actions"), "data/demo_1/actions: is missing"),
        (
            lambda f: f["data/demo_1"].pop("rewards"),
            r"data/demo_1/rewards: has none, but demo.h5 data/demo_0/ has \['rewards'\]",
        ),
        (lambda f: f["data/demo_1/obs"].pop("eef_pos"), "data/demo_1/observations: has"),
        (lambda f: f["data/demo_1/next_obs"].pop("eef_pos"), "data/demo_1/next_obs/eef_pos: is missing"),
        (lambda f: f["data/demo_1"].attrs.modify("num_samples", 9), "data/demo_1/actions: has 3 rows, but num_samples is 9"),
        (lambda f: f["data/demo_1/obs/eef_pos"].__setitem__(1, np.nan), "data/demo_1/observations/eef_pos: holds NaN.* row 1"),
        (
            lambda f: f["data/demo_1/actions"].__setitem__(0, 2),
            r"reaches from .* to 2, and data of robomimic declare no bounds",
        ),
        (lambda f: f["data"].pop("demo_1"), "mask/valid: names demo_1, which is not in the group data"),
        (lambda f: [f["data"].pop(f"demo_{i}") for i in range(3)], "data: holds no demonstration"),
    ],
)
def test_bad_robomimic_files(tmp_path, change, message):
    write_robomimic(tmp_path / "demo.h5")
    with h5py.File(tmp_path / "demo.h5", "r+") as file:
        change(file)
    with pytest.raises(DatasetError, match=f"demo.h5: {message}" if ":" in message else message) as caught:
        OfflineDataset(tmp_path / "demo.h5")
    assert "\n" not in str(caught.value)


# --------------------------------------------------------------- ManiSkill


def test_maniskill(tmp_path):
    trajectories = write_maniskill(tmp_path / "trajectory.h5")
    dataset = OfflineDataset(tmp_path / "trajectory.h5")
    assert dataset.env_id == "PickCube-v1"
    assert dataset.env_kwargs == {"obs_mode": "rgb", "control_mode": "pd_joint_pos"}
    assert dataset.seeds.tolist() == [10, 11, 12] and dataset.lengths.tolist() == list(LENGTHS)
    for key, name in (("agent_qpos", "agent/qpos"), ("sensor_data_hand_rgb", "sensor_data/hand/rgb")):
        expected = np.concatenate([trajectory[f"obs/{name}"] for trajectory in trajectories])
        np.testing.assert_array_equal(dataset.observations[key], expected)
    assert dataset.observations["extra_grasped"].shape == (sum(LENGTHS) + 3, 1)
    for name in ("actions", "rewards", "success", "terminated"):
        np.testing.assert_array_equal(getattr(dataset, name), np.concatenate([t[name] for t in trajectories]))
    assert np.flatnonzero(dataset.truncated).tolist() == [LENGTHS[0] + LENGTHS[1] - 1]  # not where it terminated
    cubes = [trajectory["env_states/actors/cube"] for trajectory in trajectories]
    np.testing.assert_array_equal(dataset.extras["env_states.actors.cube"], np.concatenate([cube[1:] for cube in cubes]))
    resets = dataset.extras["reset.env_states.actors.cube"]
    np.testing.assert_array_equal(resets[dataset.step_starts], np.stack([cube[0] for cube in cubes]))
    BC("MultiInputPolicy", None, dataset, policy_kwargs={"net_arch": [4]}, batch_size=4, seed=0).learn(1)


def test_maniskill_without_flags_or_json(tmp_path):
    """ManiSkill 2 says in the JSON file alone which episodes succeeded."""
    write_maniskill(tmp_path / "old.h5", nested=False, flags=False)
    dataset = OfflineDataset(tmp_path / "old.h5")
    assert np.flatnonzero(dataset.success).tolist() == [4, 11] and dataset.rewards is None
    assert not dataset.terminated.any() and np.flatnonzero(dataset.truncated).tolist() == [4]
    write_maniskill(tmp_path / "alone.h5", with_json=False)
    with pytest.warns(UserWarning, match=r"alone\.json is not beside the file"):
        dataset = OfflineDataset(tmp_path / "alone.h5")
    assert dataset.seeds.tolist() == [-1] * 3 and dataset.env_id == "" and dataset.terminated.sum() == 2


@pytest.mark.parametrize(
    ("change", "information", "message"),
    [
        (lambda f: f["traj_1"].pop("obs"), None, "t.h5: traj_1/obs: is missing.*replay_trajectory"),
        (lambda f: f["traj_1"].pop("actions"), None, "t.h5: traj_1/actions: is missing"),
        (lambda f: f.pop("traj_1"), None, "t.h5: traj_1: is missing, but t.json lists it"),
        (lambda f: None, "{", "t.json: file: cannot be read as JSON"),
        (lambda f: None, "[]", "t.json: episodes: is not what ManiSkill writes"),
        (
            lambda f: None,
            '{"episodes": [{"episode_id": 0, "elapsed_steps": 7}]}',
            "traj_0/actions: has 5 rows, but elapsed_steps in t.json is 7",
        ),
        (lambda f: f["traj_1"].update(rewards2=0) or f["traj_1"].pop("truncated"), None, ""),
    ],
)
def test_bad_maniskill_files(tmp_path, change, information, message):
    write_maniskill(tmp_path / "t.h5", nested=False)
    with h5py.File(tmp_path / "t.h5", "r+") as file:
        change(file)
    if information is not None:
        (tmp_path / "t.json").write_text(information)
    if not message:
        assert OfflineDataset(tmp_path / "t.h5").n_episodes == 3
        return
    with pytest.raises(DatasetError, match=message):
        OfflineDataset(tmp_path / "t.h5")


# ----------------------------------------------------------------- OGBench


@pytest.mark.parametrize("visual", [False, True])
@pytest.mark.parametrize("container", ["npz", "h5", "dict"])
def test_ogbench(tmp_path, container, visual):
    raw = ogbench_arrays(visual)
    expected = ogbench_loader(raw)
    np.savez(tmp_path / "play-v0.npz", **raw)
    with h5py.File(tmp_path / "play-v0.h5", "w") as file:
        file.update(raw)
    dataset = OfflineDataset(raw if container == "dict" else tmp_path / f"play-v0.{container}")
    before, actions, after = transitions(dataset)
    np.testing.assert_array_equal(before, expected["observations"])
    np.testing.assert_array_equal(actions, expected["actions"])
    np.testing.assert_array_equal(after, expected["next_observations"])
    assert before.dtype == raw["observations"].dtype and dataset.lengths.tolist() == list(LENGTHS)
    np.testing.assert_array_equal(dataset.truncated, expected["terminals"])
    assert not dataset.terminated.any() and dataset.rewards is None
    np.testing.assert_array_equal(dataset.extras["qpos"], raw["qpos"][np.flatnonzero(~raw["terminals"]) + 1])
    np.testing.assert_array_equal(dataset.extras["reset.qpos"][dataset.step_starts], raw["qpos"][[0, 6, 10]])


def test_what_the_loader_of_ogbench_gives():
    raw = ogbench_arrays()
    regular = ogbench_loader(raw)
    regular |= {"rewards": np.arange(12.0) - 12, "masks": np.append(np.ones(11), 0.0)}
    dataset = OfflineDataset(regular)
    before, _, after = transitions(dataset)
    np.testing.assert_array_equal(before, regular["observations"])
    np.testing.assert_array_equal(after, regular["next_observations"])
    assert np.flatnonzero(dataset.terminated).tolist() == [11] and np.flatnonzero(dataset.truncated).tolist() == [4, 7]
    compact = {**raw, "valids": (~raw["terminals"]).astype(np.float32)}
    compact["terminals"] = np.minimum(raw["terminals"] + np.append(raw["terminals"][1:], True), 1.0)
    np.testing.assert_array_equal(transitions(OfflineDataset(compact))[2], after)


def test_ogbench_or_d4rl(tmp_path):
    """Without rewards and timeouts, terminals are OGBench's. The user is told where nothing else says so."""
    raw = ogbench_arrays()
    raw.pop("qpos")
    with h5py.File(tmp_path / "d.h5", "w") as file:
        file.update(raw)
    with pytest.warns(UserWarning, match="taken to mark the last rows of trajectories"):
        assert OfflineDataset(tmp_path / "d.h5").n_steps == sum(LENGTHS)
    with pytest.warns(UserWarning, match="timeouts: are missing"):
        dataset = OfflineDataset({**raw, "rewards": np.zeros(15)})
    assert dataset.n_steps == 15 and dataset.terminated.sum() == 3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"terminals": np.zeros(3, bool)}, "terminals: has shape .3,."),
        ({"terminals": np.full(15, 0.5)}, "terminals: holds other values"),
        ({"actions": np.full((15, 2), 3.0)}, "data of OGBench declare no bounds.*action_space="),
        ({"actions": np.zeros(15, np.int32)}, "data of OGBench do not declare which actions"),
        ({"terminals": np.ones(15, bool)}, "terminals: mark every row"),
    ],
)
def test_bad_ogbench_files(tmp_path, changes, message):
    np.savez(tmp_path / "d.npz", **{**ogbench_arrays(), **changes})
    with pytest.raises(DatasetError, match=f"d.npz: .*{message}"):
        OfflineDataset(tmp_path / "d.npz")


# ------------------------------------------------------- DMC, ExORL, V-D4RL


def test_exorl_folder(tmp_path):
    """As ExORL's loader pairs them: observation[t - 1], action[t], reward[t], discount[t], observation[t] for t > 0."""
    episodes = write_dmc(tmp_path / "buffer")
    dataset = OfflineDataset(tmp_path / "buffer")
    before, actions, after = transitions(dataset)
    np.testing.assert_array_equal(before, np.concatenate([e["observation"][:-1] for e in episodes]))
    np.testing.assert_array_equal(after, np.concatenate([e["observation"][1:] for e in episodes]))
    np.testing.assert_array_equal(actions, np.concatenate([e["action"][1:] for e in episodes]))
    np.testing.assert_array_equal(dataset.rewards, np.concatenate([e["reward"][1:, 0] for e in episodes]))
    np.testing.assert_array_equal(dataset.terminated, np.concatenate([e["discount"][1:, 0] == 0 for e in episodes]))
    assert np.flatnonzero(dataset.truncated).tolist() == [4, 11]  # the time limit
    np.testing.assert_array_equal(dataset.extras["physics"], np.concatenate([e["physics"][1:] for e in episodes]))
    (one,) = open_datasets(str(tmp_path / "buffer" / "*_000001_*.npz"))
    assert one.lengths.tolist() == [LENGTHS[1]]
    assert [part.n_steps for part in open_datasets(str(tmp_path / "buffer" / "*.npz"))] == list(LENGTHS)


def test_vd4rl_images(tmp_path):
    """Dreamer's files have ``image`` and flags; DrQ's HDF5 files hold several episodes of channel-first images."""
    generator = rng()
    episode = dmc_episode(4, generator, key="image")
    episode["image"] = images(5, generator, (8, 8, 3))
    flags = {name: np.arange(5) == row for name, row in (("is_first", 0), ("is_last", 4), ("is_terminal", 4))}
    (tmp_path / "64px").mkdir()
    np.savez(tmp_path / "64px" / "a-5.npz", **episode, **flags)
    dataset = OfflineDataset(tmp_path / "64px")
    np.testing.assert_array_equal(dataset.observations, episode["image"])
    assert dataset.terminated.tolist() == [False] * 3 + [True] and dataset.observation_space.dtype == np.uint8
    parts = [dmc_episode(n, generator, image=True) for n in LENGTHS]
    step_types = [np.r_[0, np.ones(n - 1), 2] for n in LENGTHS]
    step_types[2][-1] = 1  # the recording stopped
    (tmp_path / "84px").mkdir()
    with h5py.File(tmp_path / "84px" / "shard.hdf5", "w") as file:
        for name in ("observation", "action", "reward", "discount"):
            file[name] = np.concatenate([part[name] for part in parts]).squeeze()
        file["step_type"] = np.concatenate(step_types)
    for path in (tmp_path / "84px", tmp_path / "84px" / "shard.hdf5"):
        dataset = OfflineDataset(path)
        before, actions, after = transitions(dataset)
        np.testing.assert_array_equal(before, np.concatenate([part["observation"][:-1] for part in parts]))
        np.testing.assert_array_equal(after, np.concatenate([part["observation"][1:] for part in parts]))
        np.testing.assert_array_equal(actions, np.concatenate([part["action"][1:] for part in parts]))
        assert np.flatnonzero(dataset.truncated).tolist() == [4, 7] and not dataset.terminated.any()


def test_dmc_images_beside_vectors(tmp_path):
    generator = rng()
    np.savez(tmp_path / "e.npz", **dmc_episode(4, generator), image=images(5, generator))
    assert list(OfflineDataset(tmp_path / "e.npz").observations) == ["image", "observation"]
    vector = spaces.Box(-9, 9, (4,), np.float32)
    assert OfflineDataset(tmp_path / "e.npz", observation_space=vector).observations.shape == (5, 4)
    only = spaces.Dict({"physics": spaces.Box(-9, 9, (3,), np.float64)})
    assert list(OfflineDataset(tmp_path / "e.npz", observation_space=only).observations) == ["physics"]
    with pytest.raises(DatasetError, match=r"lacks \['joints'\], which the given observation_space names"):
        OfflineDataset(tmp_path / "e.npz", observation_space=spaces.Dict({"joints": vector}))


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("1", {"reward": np.zeros(2)}, r"reward: has shape \(2,\), but action has 4 rows"),
        ("1", {"action": None}, "action: is missing"),
        ("2", {"observation": np.full((5, 4), np.nan)}, "observations: holds NaN"),
        ("1", {"action": np.full((4, 2), 7.0)}, "data of ExORL/V-D4RL/DMC declare no bounds"),
        ("1", {"observation": np.zeros((4, 5))}, r"observations: has shape \(4, 5\), expected \(n, 4\)"),
    ],
)
def test_bad_dmc_files(tmp_path, name, changes, message):
    episodes = write_dmc(tmp_path / "buffer")
    path = next((tmp_path / "buffer").glob(f"*00{name}_*"))
    episode = {**episodes[int(name)], **changes}
    np.savez(path, **{key: array for key, array in episode.items() if array is not None})
    with pytest.raises(DatasetError, match=message) as caught:
        OfflineDataset(tmp_path / "buffer")
    assert path.name in str(caught.value) or "bounds" in message


# -------------------------------------------------------------------- ALOHA


@pytest.mark.parametrize("compress", [False, True])
def test_aloha_folder(tmp_path, compress):
    episodes = write_aloha(tmp_path / "task", (4, *[2] * 10), compress)  # episode_10 comes after episode_9
    (tmp_path / "task" / "dataset_stats.pkl").write_bytes(b"statistics")
    with pytest.raises(DatasetError, match=r"data of ALOHA declare no bounds. Open it with .*action_space="):
        OfflineDataset(tmp_path / "task")
    dataset = OfflineDataset(tmp_path / "task", action_space=JOINTS)
    assert dataset.lengths.tolist() == [3] + [1] * 10  # the observation after the last step is unknown
    np.testing.assert_array_equal(dataset.actions, np.concatenate([e["action"][:-1] for e in episodes]))
    expected = np.concatenate([e["observations/images/top"] for e in episodes])
    np.testing.assert_array_equal(dataset.observations["images_top"], expected)
    expected = np.concatenate([e["observations/qpos"] for e in episodes]).astype(np.float32)
    np.testing.assert_array_equal(dataset.observations["qpos"], expected)
    assert not dataset.terminated.any() and not dataset.truncated.any() and dataset.rewards is None
    one = OfflineDataset(tmp_path / "task" / "episode_0.hdf5", action_space=JOINTS, max_episode_steps=4)
    assert one.lengths.tolist() == [3] and one.truncated.tolist() == [False, False, True]
    chosen = OfflineDataset(tmp_path / "task", action_space=JOINTS, observation_space=spaces.Box(-9, 9, (3,), np.float32))
    assert chosen.observations.shape == (24, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.pop("action"), "episode_1.hdf5: action: is missing"),
        (lambda f: f.pop("observations"), "episode_1.hdf5: observations: is missing"),
        (lambda f: f["observations"].pop("qpos"), "episode_1.hdf5: observations: has"),
        (
            lambda f: f.pop("action") and f.create_dataset("action", data=np.zeros((2, 3))),
            r"episode_1.hdf5: .*: has shape .*, but there are 2 actions",
        ),
    ],
)
def test_bad_aloha_files(tmp_path, change, message):
    write_aloha(tmp_path / "task", (6, 5, 4))
    with h5py.File(tmp_path / "task" / "episode_1.hdf5", "r+") as file:
        change(file)
    with pytest.raises(DatasetError, match=message):
        OfflineDataset(tmp_path / "task", action_space=JOINTS)


# ---------------------------------------------------------------------- all


@pytest.fixture
def samples(tmp_path):
    """A path of each format, by the format's name."""
    write_robomimic(tmp_path / "robomimic.hdf5")
    write_maniskill(tmp_path / "maniskill.h5")
    np.savez(tmp_path / "ogbench.npz", **ogbench_arrays())
    write_dmc(tmp_path / "dmc")
    write_aloha(tmp_path / "aloha")
    names = {"robomimic": "robomimic.hdf5", "ManiSkill": "maniskill.h5", "OGBench": "ogbench.npz"}
    names |= {"ExORL/V-D4RL/DMC": "dmc", "ALOHA": "aloha"}
    return {format_name: tmp_path / name for format_name, name in names.items()}


def test_each_is_recognised_by_its_contents_alone(samples, tmp_path):
    for format_name, path in samples.items():
        places = [path]
        if path.is_file():
            places += [tmp_path / "no_suffix", tmp_path / "wrong.pkl"]
            for place in places[1:]:
                shutil.copy(path, place)
        for place in places:
            with Probe(place) as probe:
                assert [known.name for known in registry.known_formats() if known.recognizes(probe)] == [format_name]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # ManiSkill's JSON file is not beside the copies
                assert OfflineDataset(place, action_space=JOINTS if format_name == "ALOHA" else None).n_episodes == 3


def test_damaged_files_are_named(samples, tmp_path):
    for path in samples.values():
        file = path if path.is_file() else sorted(path.iterdir())[1]
        content = file.read_bytes()
        for damaged in (content[: len(content) // 2], b"", b"no data"):
            file.write_bytes(damaged)
            with pytest.raises(DatasetError) as caught:
                OfflineDataset(path, action_space=JOINTS if path.name == "aloha" else None)
            assert file.name in str(caught.value) and "\n" not in str(caught.value)
        file.write_bytes(content)


def test_samples_never_pair_a_dummy_action(samples):
    for name in ("OGBench", "ExORL/V-D4RL/DMC"):
        dataset = OfflineDataset(samples[name])
        buffer = OfflineReplayBuffer(dataset, dataset.observation_space, dataset.action_space, "cpu", n_steps=3)
        assert buffer.size() == sum(LENGTHS) and np.abs(buffer.actions).max() <= 1
