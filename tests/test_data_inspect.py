"""The page of ``sb3-offline inspect``: for several files, with success examples, and of the table."""

import json
from html.parser import HTMLParser

import h5py
import numpy as np
import pytest
from data_files import ACTIONS, BOTH, IMAGES, OPTIONS, STATES, make_episode, write_dataset
from gymnasium import spaces

from sb3_offline import cli
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import save_examples
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.data_tools.inspecting.dataset_statistics import (
    action_histograms,
    episode_returns,
    inspect_dataset,
    solved_by,
    table_coverage,
)
from sb3_offline.data_tools.inspecting.joined_datasets import JoinedDatasets

VOID = {"meta", "img", "br", "rect", "line", "circle", "image", "polyline"}


class Page(HTMLParser):
    """Holds the tables, texts and references of a page, and checks that its tags are closed."""

    def __init__(self, path):
        super().__init__()
        self.open, self.tables, self.references, self.texts, self.tags = [], [], [], [], []
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.references += [value for name, value in attributes if name in ("src", "href", "srcset", "action", "data")]
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)
        if "td" in self.open or "th" in self.open:
            self.tables[-1][-1][-1] += data

    def table(self, head):
        """:return: the rows of the table whose head begins like this: the other cells by the first one"""
        (found,) = (table for table in self.tables if table[0][: len(head)] == head)
        return {first: rest for first, *rest in found[1:]}


def inspect(tmp_path, *arguments):
    page = tmp_path / "page.html"
    cli.main(["inspect", *map(str, arguments), "--html", str(page)])
    return Page(page)


def assert_stands_alone(page):
    assert all(reference.startswith("data:image/png;base64,") for reference in page.references)
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    style = next(text for text in page.texts if ":root" in text)
    assert "url(" not in style and "@import" not in style


def test_the_page_agrees_with_the_summary_and_needs_nothing_else(tmp_path, capsys):
    path, odd = tmp_path / "a<b>.h5", "left <i>&"
    with DatasetWriter(path, BOTH, ACTIONS, sources=[odd, "right"], extras={"qpos": ((2,), float)}) as writer:
        for index in range(30):
            writer.add_episode(**{**make_episode(index, BOTH), "source": odd if index % 3 else "right"})
    page = inspect(tmp_path, path)
    printed = capsys.readouterr().out
    assert "no warnings" in printed and "Page:" in printed
    summary = inspect_dataset(path)
    assert_stands_alone(page)
    rows = page.table(["source", "episodes"])
    assert list(rows) == ["all", odd, "right"] == list(summary["groups"])
    for label, group in summary["groups"].items():
        spread = group["return"]
        expected = [
            f"{group['episodes']:,}",
            f"{group['steps']:,}",
            f"{group['success']:.1%}",
            f"{group['success_at_end']:.1%}",
        ]
        assert rows[label][:4] == expected
        assert rows[label][4:7] == [f"{spread[name]:.5g}" for name in ("mean", "min", "max")]
    arrays = page.table(["array", "shape"])
    assert arrays["observations/image"][0] == f"{summary['n_steps'] + 30} × 8 × 6 × 3"
    assert arrays["extras/qpos"][2:] == [f"{summary['arrays']['extras/qpos'][end]:.5g}" for end in ("min", "max")]
    text = "".join(page.texts)
    for part in ("a<b>.h5", "No warnings", f"saturated {summary['actions']['saturated'][1]:.1%}", "not solved"):
        assert part in text
    assert page.tags.count("img") > 8  # frames of a success and of a failure

    data = JoinedDatasets(path)
    assert [counts.sum() for counts, _ in action_histograms(data)] == [data.n_steps] * 2
    shares = solved_by(data)
    assert shares["right"][-1] == pytest.approx(summary["groups"]["right"]["success"])
    after = [
        np.argmax(make_episode(index, BOTH)["success"]) + 1
        for index in range(30)
        if make_episode(index, BOTH)["success"].any()
    ]
    assert shares["all"][2] == pytest.approx(np.mean(np.array(after) <= 3) * len(after) / 30)


def test_shards_are_inspected_together(tmp_path, capsys):
    parts = [
        write_dataset(tmp_path / "shard0.h5", 5, STATES, sources=["right", "left"]),
        write_dataset(tmp_path / "shard1.h5", 7, STATES, first=3, provenance={"shard": 1}),
    ]
    data = JoinedDatasets(str(tmp_path / "shard*.h5"))
    together = {name: np.concatenate([OfflineDataset(p.path).arrays[name] for p in data.parts]) for name in data.arrays}
    for name, array in data.arrays.items():
        rows = np.array([len(array) - 1, 0, len(array) // 2])
        if name != "episodes/source":  # the files hold their labels in different orders
            np.testing.assert_array_equal(array[:], together[name])
            np.testing.assert_array_equal(array[rows], together[name][rows])
            np.testing.assert_array_equal(array[3:-2], together[name][3:-2])
    assert [data.sources[number] for number in data.source] == [e["source"] for part in parts for e in part]
    assert data.locate(4)[1] == 4 and data.locate(5) == (data.parts[1], 0)
    cli.main(["inspect", "--json", str(tmp_path / "shard*.h5")])
    summary = json.loads(capsys.readouterr().out)
    assert [file["episodes"] for file in summary["files"]] == [5, 7] and len(summary["provenance"]) == 2
    assert summary["groups"]["left"]["episodes"] == sum(e["source"] == "left" for part in parts for e in part)
    (warning,) = summary["warnings"]
    assert warning["problem"] == "2 repeat an earlier one (5, 6)" and "seed" in warning["remedy"]


def test_labels_that_one_file_lacks_are_named(tmp_path, capsys):
    write_dataset(tmp_path / "a.h5", 2, STATES)
    episodes = [{k: v for k, v in make_episode(i, STATES).items() if k not in ("source", "success")} for i in (2, 3)]
    with DatasetWriter(tmp_path / "b.h5", STATES, ACTIONS, **{**OPTIONS, "sources": None, "success": False}) as writer:
        for episode in episodes:
            writer.add_episode(**episode)
    cli.main(["inspect", "--json", str(tmp_path / "a.h5"), str(tmp_path / "b.h5")])
    warnings = json.loads(capsys.readouterr().out)["warnings"]
    assert {"episodes/source", "success"} == {w["field"] for w in warnings if "is not in all of the files" in w["problem"]}


def test_examples_are_held_against_the_data(tmp_path, capsys):
    """In frames with a moving bright spot, those of other episodes are similar, and those of another camera are not."""
    rng = np.random.default_rng(0)

    def episode(steps=20):
        frames = np.full((steps + 1, 24, 30, 3), 90, np.uint8) + rng.integers(0, 5, (steps + 1, 24, 30, 3), dtype=np.uint8)
        for step, frame in enumerate(frames):
            frame[4 + step // 2 : 12 + step // 2, step : step + 8] = 240
        return frames

    space = spaces.Box(0, 255, (24, 30, 3), np.uint8)
    with DatasetWriter(tmp_path / "a.h5", space, ACTIONS, rewards=False) as writer:
        for _ in range(6):
            actions = rng.uniform(ACTIONS.low, ACTIONS.high, (20, 2))
            writer.add_episode(episode(), actions, success=np.arange(20) > 15)
    inside = OfflineDataset(tmp_path / "a.h5").observations[17:21]
    save_examples(tmp_path / "own.h5", inside, space, {"held_out": True})
    page = inspect(tmp_path, tmp_path / "a.h5", "--examples", tmp_path / "own.h5")
    text = "".join(page.texts)
    assert "compared with 126 observations: 4 are among them, 0 are unlike all of them" in text
    assert "4 of 4 are observations of this data, but are recorded as held out from it" in capsys.readouterr().out
    assert_stands_alone(page)
    np.save(tmp_path / "alike.npy", episode()[17:21])
    summary = inspect_dataset(tmp_path / "a.h5", tmp_path / "alike.npy")
    assert summary["examples"]["identical"] == 0 == len(summary["examples"]["far"]) and summary["warnings"] == []
    np.save(tmp_path / "turned.npy", episode()[17:21, ::-1])
    inspect(tmp_path, tmp_path / "a.h5", "--examples", tmp_path / "turned.npy")
    assert "examples: 4 of 4 are unlike every observation of the data" in capsys.readouterr().out
    with pytest.raises(DatasetError, match="examples"):
        inspect_dataset(tmp_path / "a.h5", np.zeros((2, 5)))


@pytest.mark.parametrize("kind", ["states", "unlabelled", "d4rl", "empty", "one", "text"])
def test_any_dataset_has_a_page(tmp_path, kind):
    path, rng = tmp_path / "a.h5", np.random.default_rng(0)
    if kind == "d4rl":
        with h5py.File(path, "w") as file:
            file["observations"], file["actions"] = rng.normal(size=(60, 3)), rng.uniform(-1, 1, (60, 2))
            file["rewards"], file["terminals"] = rng.normal(size=60), np.arange(60) % 20 == 19
    elif kind == "unlabelled":  # a stack of frames as floats, channel-first, and discrete actions
        space = spaces.Box(0, 1, (4, 84, 200), np.float32)
        with DatasetWriter(path, space, spaces.Discrete(3), rewards=False, success=False) as writer:
            writer.add_episode(rng.random((11, 4, 84, 200)), rng.integers(0, 3, 10))
    else:
        write_dataset(path, {"states": 9, "empty": 0, "one": 1, "text": 0}[kind], IMAGES if kind == "one" else STATES)
    if kind == "text":
        with DatasetWriter(path, STATES, ACTIONS, mode="w", extras={"note": ((), "S4")}) as writer:
            episode = {**make_episode(0, STATES, 5), "extras": {"note": np.array([b"a", b"b", b"", b"", b""])}}
            writer.add_episode(**{key: value for key, value in episode.items() if key != "source"})
    examples = []
    if kind == "one":  # no other episode says what is near
        np.save(tmp_path / "e.npy", OfflineDataset(path).observations[:1])
        examples = ["--examples", tmp_path / "e.npy"]
    page = inspect(tmp_path, path, *examples)
    assert_stands_alone(page)
    text = "".join(page.texts)
    assert ("Film strips" in text) == (kind in ("unlabelled", "one")) and "In the file" in text
    assert "Where the gripper goes" not in text
    if kind == "unlabelled":
        assert sum(int(cells[0]) for cells in page.table(["action", "steps"]).values()) == 10


def test_states_of_the_table_are_drawn_and_mapped(tmp_path):
    pytest.importorskip("metaworld")
    import gymnasium as gym

    from sb3_offline.data_tools.collecting.scripted import collect_scripted
    from sb3_offline.envs.multimodal_metaworld import TASKS, scene
    from sb3_offline.envs.multimodal_metaworld.tables import find_table

    table = find_table("paper")
    path = tmp_path / "states.h5"
    collect_scripted(path, episodes_per_task=1, tasks=("door-open", "lever-pull"), n_workers=1, progress=False)
    page, data, summary = inspect(tmp_path, path), JoinedDatasets(path), inspect_dataset(path)
    assert_stands_alone(page)
    assert page.tags.count("img") == 2 * 8 and page.tags.count("image") == 3
    rewards = np.asarray(data.arrays["extras/task_reward"][:])[:50, TASKS.index(data.sources[data.source[0]])]
    assert episode_returns(data)[0] == pytest.approx(rewards.sum(), rel=1e-5)
    tasks = page.table(["source", *TASKS[:1]])
    assert tasks["door-open"][1] == "{success:.1%} {return:.4g}".format(**summary["tasks"]["door-open"]["door-open"])

    coverage = table_coverage(data)
    assert coverage.counts["all"].sum() == data.n_steps + 2 and set(coverage.bodies) == set(table.positions)
    assert np.abs(np.subtract(coverage.bodies["dial"], table.positions["dial"][:2])).max() <= scene.JITTER
    x, y = np.unravel_index(coverage.counts["door-open"].argmax(), coverage.counts["door-open"].shape)
    hands = data.arrays["observations"][:][:51, :2]
    inside = (np.abs(hands[:, 0] - coverage.edges[0][x] - 0.01) <= 0.01) & (
        np.abs(hands[:, 1] - coverage.edges[1][y] - 0.01) <= 0.01
    )
    assert inside.sum() == coverage.counts["door-open"].max()
    env, state = gym.make("MultimodalMetaworld-v0").unwrapped, data.arrays["extras/scene_state"][7:8][0]
    env.scene.set_state(state)
    np.testing.assert_array_equal(env.scene.data.mocap_pos[0], state[table.scene_state["hand_target"]])
    np.testing.assert_array_equal(env.scene.data.qpos, state[table.scene_state["joints"]])
