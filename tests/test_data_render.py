import gymnasium as gym
import h5py
import numpy as np
import pytest

pytest.importorskip("metaworld")

from data_files import forget_checksums, write_dataset

from sb3_offline import cli
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data_tools.collecting.scripted import collect_scripted
from sb3_offline.data_tools.converting import render_dataset

CAMERA = {"azimuth": 120.0, "lookat": [0.1, 0.7, 0.1]}


@pytest.fixture(scope="module")
def states(tmp_path_factory):
    """Two attempts at each of two tasks."""
    path = tmp_path_factory.mktemp("states") / "states.h5"
    collect_scripted(path, episodes_per_task=2, tasks=("drawer-open", "door-open"), n_workers=1, progress=False)
    return path


def assert_same_but_observations(one: OfflineDataset, other: OfflineDataset) -> None:
    assert one.arrays.keys() == other.arrays.keys() and one.sources == other.sources
    for name in one.arrays.keys() - {"observations"}:
        np.testing.assert_array_equal(one.arrays[name], other.arrays[name])


def test_drawn_frames_are_those_that_collecting_gives(tmp_path, states, capsys):
    collected, drawn = tmp_path / "collected.h5", tmp_path / "drawn.h5"
    tasks = ("drawer-open", "door-open")
    collect_scripted(collected, episodes_per_task=2, tasks=tasks, obs_type="pixels", n_workers=1, progress=False)
    cli.main(["render", str(states), str(drawn), "--workers", "2"])
    assert "4 episodes drawn" in capsys.readouterr().out
    one, two = OfflineDataset(collected), OfflineDataset(drawn)
    np.testing.assert_array_equal(one.observations, two.observations)
    assert_same_but_observations(one, two)
    assert one.observation_space == two.observation_space
    made = two.provenance
    assert made["camera"]["azimuth"] == 170 and made["renderer"] and made["rendered"]["provenance"]["seed"] == 0
    before = drawn.read_bytes()
    cli.main(["render", str(states), str(drawn)])
    assert "is complete already" in capsys.readouterr().out and drawn.read_bytes() == before


def test_another_size_and_camera_are_what_the_environment_observes(tmp_path, states):
    drawn = tmp_path / "drawn.h5"
    view = ["--size", "20", "--azimuth", "120", "--lookat", "0.1", "0.7", "0.1"]
    cli.main(["render", str(states), str(drawn), *view, "--workers", "1"])
    dataset, source = OfflineDataset(drawn), OfflineDataset(states)
    assert_same_but_observations(dataset, source)
    assert dataset.observation_space.shape == (20, 20, 3)
    assert dataset.env_kwargs == {"obs_type": "pixels", "frame_size": 20, "camera": CAMERA}
    env = gym.make(dataset.env_id, **dataset.env_kwargs)
    assert env.observation_space == dataset.observation_space
    frame, _ = env.reset(seed=int(dataset.seeds[1]))
    for row in range(3):
        np.testing.assert_array_equal(frame, dataset.observations[51 + row])
        frame, *_ = env.step(dataset.actions[50 + row])
    usual = render_dataset.draw_moments(dataset, 1, np.array([0, 2]))
    assert usual.shape == (2, 20, 20, 3) and (usual[1] == dataset.observations[53]).all()
    default = gym.make(dataset.env_id, frame_size=20)
    assert (default.reset(seed=int(dataset.seeds[1]))[0] != dataset.observations[51]).mean() > 0.5
    for made in (env, default):
        made.close()


def test_an_interrupted_run_is_continued(tmp_path, states, monkeypatch):
    whole, parted = tmp_path / "whole.h5", tmp_path / "parted.h5"
    options = {"frame_size": 16, "n_workers": 1, "progress": False}
    assert render_dataset.render_dataset(states, whole, **options) == 4
    draw, drawn = render_dataset._draw, []

    def interrupt(*args):
        if len(drawn) == 2:
            raise KeyboardInterrupt
        drawn.append(args)
        return draw(*args)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(render_dataset, "_draw", interrupt)
        render_dataset.render_dataset(states, parted, **options)
    assert OfflineDataset(parted).n_episodes == 2
    assert render_dataset.render_dataset(states, parted, **options) == 2
    assert parted.read_bytes() == whole.read_bytes()
    for other in ({"frame_size": 17}, {"camera": {"azimuth": 0.0}}):
        with pytest.raises(DatasetError, match=r"parted.h5: file: exists already.*--overwrite"):
            render_dataset.render_dataset(states, parted, **{**options, **other})
    assert render_dataset.render_dataset(states, parted, **{**options, "frame_size": 17, "overwrite": True}) == 4
    assert OfflineDataset(parted).observation_space.shape == (17, 17, 3)
    relabelled = tmp_path / "relabelled.h5"
    relabelled.write_bytes(states.read_bytes())
    with h5py.File(relabelled, "r+") as file:
        file["success"][:] = True
        forget_checksums(file)
    with pytest.raises(DatasetError, match="is not of this source"):
        render_dataset.render_dataset(relabelled, whole, **options)


def test_what_cannot_be_drawn_is_named(tmp_path, states):
    options = {"n_workers": 1, "progress": False}
    render = render_dataset.render_dataset
    write_dataset(tmp_path / "other.h5", 2)
    write_dataset(tmp_path / "bare.h5", 2, env_id="MultimodalMetaworld-v0")
    for name, message in (("other.h5", "env_id: is ''"), ("bare.h5", "extras/scene_state: is missing.*Collect")):
        with pytest.raises(DatasetError, match=message):
            render(tmp_path / name, tmp_path / "out.h5", **options)
    with pytest.raises(DatasetError, match="is the source itself"):
        render(states, states, overwrite=True, **options)
    with pytest.raises(ValueError, match=r"Unknown entries \['zoom'\] of camera; choose from lookat"):
        render(states, tmp_path / "out.h5", camera={"zoom": 2}, **options)
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes(states.read_bytes())
    with h5py.File(damaged, "r+") as file:
        file["extras/scene_state"][120] = np.nan
    with pytest.raises(DatasetError, match="extras/scene_state: holds NaN or infinity in episode 2"):
        render(damaged, tmp_path / "out.h5", frame_size=8, **options)
