"""Data of robots and of other offline learners: LeRobot, d3rlpy, pickled trajectories, RLDS, and live objects."""

import io
import json
import pickle
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from data_files import BOTH, write_dataset
from gymnasium import spaces
from PIL import Image
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
    objects = np.empty(2, dtype=object)
    objects[:] = given
    flat = {name: np.concatenate([t[name] for t in given]) for name in given[0]}
    for other in (tuple(given), objects, flat):  # the last one has D4RL's names
        (tmp_path / "other").write_bytes(pickle.dumps(other, protocol))
        np.testing.assert_array_equal(OfflineDataset(tmp_path / "other").observations, wanted)


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
            "actions: reaches from .* to 1.5, and data of trajectories declare",
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

FPS = 10
LENGTHS = (6, 4, 5)
VIDEO = {"dtype": "video", "shape": [40, 48, 3], "names": ["height", "width", "channels"]}


def frame_color(row: int, camera: int = 0) -> tuple[int, int, int]:
    return (40 + 10 * row, 200 - 10 * row, 50 + 100 * camera)


def write_video(path: Path, rows: list[int], camera: int, start: int = 0) -> None:
    av = pytest.importorskip("av")
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=FPS)
        stream.width, stream.height, stream.pix_fmt, stream.gop_size = 48, 40, "yuv420p", 3
        for row in rows:
            image = np.full((40, 48, 3), frame_color(row, camera), np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def write_lerobot(
    root: Path, version: str, *, cameras: tuple[str, ...] = (), lengths: tuple[int, ...] = LENGTHS, **changes: Any
) -> dict[str, np.ndarray]:
    """
    A dataset in LeRobot's published layout. Version 3 puts all episodes but the last into one file.

    :param changes: columns to replace, or to leave out (``None``)
    :return: the columns
    """
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    n, rng = sum(lengths), np.random.default_rng(0)
    episode_index = np.repeat(np.arange(len(lengths)), lengths)
    frame_index = np.concatenate([np.arange(length) for length in lengths])
    ends = np.append(episode_index[1:] != episode_index[:-1], True)
    columns: dict[str, Any] = {
        "observation.state": rng.normal(size=(n, 3)),
        "action": rng.uniform(-1, 1, (n, 2)).astype(np.float32),
        "next.reward": np.arange(n, dtype=np.float32),
        "next.success": ends & (episode_index != 1),
        "next.done": ends,
        "timestamp": (frame_index / FPS).astype(np.float32),
        "frame_index": frame_index,
        "episode_index": episode_index,
        "index": np.arange(n),
        "task_index": episode_index % 2,
    }
    columns = {name: column for name, column in {**columns, **changes}.items() if column is not None}
    features: dict[str, Any] = {
        name: (
            {"dtype": str(column.dtype), "shape": list(column.shape[1:]) or [1], "names": None}
            if isinstance(column, np.ndarray)
            else {"dtype": "image", "shape": [4, 5, 3], "names": ["height", "width", "channel"]}
        )
        for name, column in columns.items()
    } | {f"observation.images.{name}": VIDEO for name in cameras}
    rows = [{} for _ in range(n)]
    for name, column in columns.items():
        for row, value in zip(rows, column, strict=True):
            row[name] = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    is_old = version < "v3"
    files = [[e] for e in range(len(lengths))] if is_old else [list(range(len(lengths) - 1)), [len(lengths) - 1]]
    episodes = [{"episode_index": e, "tasks": [f"task {e % 2}"], "length": length} for e, length in enumerate(lengths)]
    for index, members in enumerate(file for file in files if file):
        chunk = f"chunk-{index // 2:03d}"  # two files in each chunk
        name = f"episode_{index:06d}" if is_old else f"file-{index:03d}"
        path = root / "data" / chunk / f"{name}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist([row for row in rows if row["episode_index"] in members]), path)
        numbers = [row for row in range(n) if episode_index[row] in members]
        for place, camera in enumerate(cameras):
            key = f"observation.images.{camera}"
            folder = f"videos/{chunk}/{key}" if is_old else f"videos/{key}/{chunk}"
            write_video(root / folder / f"{name}.mp4", numbers, place)
        for member in members if not is_old else []:
            where = {"chunk_index": index // 2, "file_index": index}
            start = (int(np.argmax(episode_index == member)) - numbers[0]) / FPS
            episodes[member] |= {f"data/{name}": value for name, value in where.items()}
            for camera in cameras:
                at = {**where, "from_timestamp": start}
                episodes[member] |= {f"videos/observation.images.{camera}/{name}": value for name, value in at.items()}
    meta = root / "meta"
    tasks = [{"task_index": index, "task": f"task {index}"} for index in range(2)]
    if is_old:
        meta.mkdir()
        (meta / "episodes.jsonl").write_text("\n".join(map(json.dumps, episodes)))
        (meta / "tasks.jsonl").write_text("\n".join(map(json.dumps, tasks)))
    else:
        (meta / "episodes" / "chunk-000").mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(episodes), meta / "episodes" / "chunk-000" / "file-000.parquet")
        pq.write_table(pa.Table.from_pylist(tasks), meta / "tasks.parquet")
    paths = {
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    }
    info = {
        "codebase_version": version,
        "robot_type": "so100",
        "fps": FPS,
        "chunks_size": 2,
        "total_episodes": len(lengths),
        "features": features,
        **(paths if is_old else {}),
    }
    (meta / "info.json").write_text(json.dumps(info))
    return columns


@pytest.mark.parametrize("version", ["v2.0", "v2.1", "v3.0"])
def test_lerobot(tmp_path, version):
    columns = write_lerobot(tmp_path / "robot", version)
    dataset = OfflineDataset(tmp_path / "robot")
    # The second episode did not succeed: it was truncated, and loses the step after which nothing was seen
    assert dataset.lengths.tolist() == [6, 3, 5] and dataset.guessed_actions
    assert np.flatnonzero(dataset.terminated).tolist() == [5, 13] and np.flatnonzero(dataset.truncated).tolist() == [8]
    assert dataset.sources == ["task 0", "task 1"] and dataset.source.tolist() == [0, 1, 0]
    kept = np.delete(np.arange(15), 9)
    np.testing.assert_array_equal(dataset.rewards, columns["next.reward"][kept])
    np.testing.assert_array_equal(dataset.success, columns["next.success"][kept])
    np.testing.assert_array_equal(dataset.actions, columns["action"][kept])
    rows = [*range(6), 5, *range(6, 10), *range(10, 15), 14]
    np.testing.assert_array_equal(dataset.observations, columns["observation.state"][rows].astype(np.float32))


def test_lerobot_without_the_optional_columns(tmp_path):
    write_lerobot(tmp_path / "a", "v2.1", **{"next.success": None, "next.reward": None, "next.done": None}, lengths=(4,))
    dataset = OfflineDataset(tmp_path / "a")
    assert dataset.lengths.tolist() == [3] and dataset.rewards is None and dataset.success is None
    write_lerobot(tmp_path / "b", "v3.0", **{"next.success": None, "effort": np.ones((15, 2)), "timestamp": None})
    with pytest.warns(UserWarning, match=r"next\.done: does not tell terminations from time limits"):
        assert OfflineDataset(tmp_path / "b").terminated.sum() == 3
    limited = OfflineDataset(tmp_path / "b", max_episode_steps=6)
    assert limited.lengths.tolist() == [5, 4, 5] and limited.extras["effort"].shape == (14, 2)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_videos_of_lerobot_are_decoded_once_by_convert(tmp_path, version):
    write_lerobot(tmp_path / "robot", version, cameras=("front", "wrist"))
    dataset = OfflineDataset(tmp_path / "robot")
    assert list(dataset.observation_space) == ["images_front", "images_wrist", "state"]
    rows = [*range(6), 5, *range(6, 10), *range(10, 15), 14]
    for camera, key in enumerate(("images_front", "images_wrist")):
        images = dataset.observations[key]
        wanted = np.array([frame_color(row, camera) for row in rows])
        assert images.shape == (17, 40, 48, 3)
        assert np.abs(np.asarray(images).mean((1, 2)) - wanted).max() < 5  # half of what tells rows apart; the codec is lossy
        for order in (slice(5, 9), np.array([16, 3, 3, 0]), slice(0, 2)):
            np.testing.assert_array_equal(images[order], images[:][order])
    with pytest.raises(DatasetError, match=r"images_front: are encoded, .*sb3-offline convert .*robot data.h5"):
        BC("MultiInputPolicy", None, dataset=dataset, dataset_storage="mmap", **SMALL).learn(1)
    main(["inspect", str(tmp_path / "robot"), "--html", str(tmp_path / "page.html")])
    main(["convert", str(tmp_path / "robot"), str(tmp_path / "d.h5")])
    converted = OfflineDataset(tmp_path / "d.h5")
    assert converted.storage == "contiguous"
    for name, array in dataset.arrays.items():
        np.testing.assert_array_equal(np.asarray(array), np.asarray(converted.arrays[name]), err_msg=name)
    BC("MultiInputPolicy", None, dataset=tmp_path / "robot", **SMALL).learn(1)
    space = spaces.Dict({key: dataset.observation_space[key] for key in ("images_wrist", "state")})
    assert OfflineDataset(tmp_path / "robot", observation_space=space).observations.keys() == space.spaces.keys()


def test_encoded_images_of_lerobot(tmp_path):
    images = []
    for row in range(15):
        file = io.BytesIO()
        Image.new("RGB", (5, 4), frame_color(row)).save(file, "PNG")
        images.append({"bytes": file.getvalue(), "path": None})
    write_lerobot(tmp_path / "robot", "v3.0", **{"observation.image": images, "observation.state": None})
    dataset = OfflineDataset(tmp_path / "robot")
    assert dataset.observation_space == spaces.Box(0, 255, (4, 5, 3), np.uint8)  # the only key
    assert np.asarray(dataset.observations)[12, 0, 0].tolist() == list(frame_color(11))


FRONT = "observation.images.front"
#: Changes of features in info.json, by what is damaged; ``None`` removes one
WRONG_FEATURES: dict[str, dict[str, Any]] = {
    "depth": {FRONT: {**VIDEO, "info": {"video.is_depth_map": True}}},
    "channels": {FRONT: {**VIDEO, "shape": [3, 40, 48], "names": None}},
    "size": {FRONT: {**VIDEO, "shape": [64, 64, 3]}},
    "action": {"action": None, "action.arm": {"dtype": "float32", "shape": [2]}},
    "width": {"observation.state": {"dtype": "float32", "shape": [7]}},
}


def damage(root: Path, what: str) -> None:
    pq = pytest.importorskip("pyarrow.parquet")
    meta, info = root / "meta", json.loads((root / "meta" / "info.json").read_text())
    table = root / "data" / "chunk-000" / "episode_000001.parquet"
    video = root / "videos" / "chunk-000" / FRONT / "episode_000001.mp4"
    if what in WRONG_FEATURES:
        features = {**info["features"], **WRONG_FEATURES[what]}
        info["features"] = {name: feature for name, feature in features.items() if feature}
        (meta / "info.json").write_text(json.dumps(info))
        return
    how = {
        "video": lambda: video.unlink(),
        "half a video": lambda: write_video(video, [6, 7], 0),
        "no video": lambda: video.write_bytes(b"version https://git-lfs.github.com/spec/v1"),
        "table": lambda: table.unlink(),
        "half a table": lambda: table.write_bytes(table.read_bytes()[:99]),
        "no index": lambda: pq.write_table(pq.read_table(table).drop(["episode_index"]), table),
        "info": lambda: (meta / "info.json").write_text("{"),
        "version": lambda: (meta / "info.json").write_text(json.dumps({**info, "codebase_version": "v1.6"})),
        "episodes": lambda: (meta / "episodes.jsonl").unlink(),
        "odd lines": lambda: (meta / "episodes.jsonl").write_text("[1, 2]"),
        "length": lambda: (meta / "episodes.jsonl").write_text(
            (meta / "episodes.jsonl").read_text().replace('"length": 4', '"length": 9')
        ),
        "bounds": lambda: None,
    }
    how[what]()


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("video", r"episode_000001\.mp4: observation\.images\.front: is missing .* or leave the camera out"),
        ("half a video", r"episode_000001\.mp4: observation\.images\.front: has no frame at .* \(2 frames"),
        ("no video", r"episode_000001\.mp4: observation\.images\.front: cannot be decoded"),
        ("table", r"episode_000001\.parquet: file: is missing"),
        ("half a table", r"episode_000001\.parquet: file: is no Parquet table"),
        ("info", r"info\.json: file: is missing from this LeRobot dataset, or is no JSON"),
        ("bounds", r"actions: has shape \(14, 2\), expected \(n, 3\)"),
        ("episodes", r"episodes\.jsonl: file: is missing"),
        ("no index", r"data: episode_index: is missing in some of LeRobot's tables"),
        ("odd lines", "meta: episode_index: is missing from the metadata of an episode"),
        ("length", "episode 1: has 4 rows in the tables, but LeRobot's metadata say 9"),
        ("size", r"has frames of shape \(40, 48, 3\), but info\.json declares \(64, 64, 3\)"),
        ("action", r"features: action: is missing, but there are action\.arm"),
        ("version", r"codebase_version: is v1\.6, and LeRobot's versions"),
        ("width", r"observation\.state: has 3 values in a row, but info\.json declares the shape \(7,\)"),
    ],
)
def test_damaged_lerobot_data(tmp_path, what, message):
    write_lerobot(tmp_path / "robot", "v2.1", cameras=("front",))
    damage(tmp_path / "robot", what)
    with pytest.raises(DatasetError, match=message):
        space = spaces.Box(-1, 1, (3,)) if what == "bounds" else None
        np.asarray(OfflineDataset(tmp_path / "robot", action_space=space).observations["images_front"])


def test_cameras_of_other_kinds(tmp_path):
    write_lerobot(tmp_path / "robot", "v2.1", cameras=("front",))
    damage(tmp_path / "robot", "channels")
    assert np.asarray(OfflineDataset(tmp_path / "robot").observations["images_front"]).shape == (17, 40, 48, 3)
    damage(tmp_path / "robot", "depth")
    with pytest.warns(UserWarning, match=r"observation\.images\.front: holds depth images.* left out"):
        assert OfflineDataset(tmp_path / "robot").observation_space == spaces.Box(-np.inf, np.inf, (3,))


def test_actions_of_lerobot_need_bounds(tmp_path):
    write_lerobot(tmp_path / "robot", "v3.0", action=np.full((15, 2), 9.0))
    with pytest.raises(DatasetError, match=r"action: reaches from 9 to 9, and data of LeRobot declare no.*action_space="):
        OfflineDataset(tmp_path / "robot")
    space = spaces.Box(-180, 180, (2,))
    assert OfflineDataset(tmp_path / "robot", action_space=space).action_space == space
