import json

import h5py
import numpy as np
import pytest
from data_files import BOTH, IMAGES, STATES, make_observations, write_dataset
from gymnasium import spaces
from PIL import Image

from sb3_offline import cli
from sb3_offline.data.convert import convert
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import load_examples, save_examples
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data_tools.converting.extract_examples import extract_examples

CHANNEL_FIRST = spaces.Box(0, 255, (3, 8, 6), np.uint8)
FRAMES = make_observations(IMAGES, 5, np.random.default_rng(0))


def write_as(kind, folder):
    if kind == "array":
        return FRAMES
    path = folder / f"examples.{kind}"
    if kind == "npz":
        np.savez(path, observations=FRAMES, actions=np.zeros(5))
    elif kind == "single.npz":
        np.savez(path, frames=FRAMES)
    elif kind == "npy":
        np.save(path, FRAMES)
    elif kind == "channel-first.npy":
        np.save(path, FRAMES.transpose(0, 3, 1, 2))
    elif kind == "h5":
        save_examples(path, FRAMES, IMAGES, {"held_out": True})
    elif kind == "png":
        path.mkdir()
        for index, frame in enumerate(FRAMES):
            Image.fromarray(frame).save(path / f"{index:03d}.PNG")
        (path / "notes.txt").write_text("not a picture")
    return path


@pytest.mark.parametrize("kind", ["array", "npz", "single.npz", "npy", "channel-first.npy", "h5", "png"])
def test_all_kinds_of_files_give_the_same_examples_in_both_layouts(tmp_path, kind):
    source = write_as(kind, tmp_path)
    np.testing.assert_array_equal(load_examples(source, IMAGES), FRAMES)
    turned = load_examples(str(source) if kind != "array" else source, CHANNEL_FIRST)
    np.testing.assert_array_equal(turned, FRAMES.transpose(0, 3, 1, 2))
    assert turned.dtype == np.uint8


def test_photographs_are_turned_upright_and_resized(tmp_path):
    # 60x80, left half red and right half blue, stored on its side as telephones do
    picture = np.zeros((80, 60, 3), np.uint8)
    picture[:, :30, 0] = picture[:, 30:, 2] = 200
    exif = Image.Exif()
    exif[0x0112] = 6  # to be seen upright, turn it clockwise
    Image.fromarray(np.rot90(picture)).save(tmp_path / "a.jpeg", exif=exif, quality=95)
    Image.fromarray(picture).convert("L").save(tmp_path / "b.png")
    first, second = load_examples(tmp_path, IMAGES)
    assert np.abs(first.astype(int) - picture[::10, ::10]).max() < 12
    assert (second[..., 0] == second[..., 1]).all() and second[0, 0, 0] > second[0, 5, 0] > 0
    assert load_examples(tmp_path, spaces.Box(0, 255, (8, 6, 1), np.uint8)).shape == (2, 8, 6, 1)


def test_dict_and_state_examples(tmp_path):
    examples = make_observations(BOTH, 4, np.random.default_rng(0))
    np.savez(tmp_path / "a.npz", **examples)
    save_examples(tmp_path / "a.h5", examples, BOTH)
    learner = spaces.Dict({"image": CHANNEL_FIRST, "state": STATES})
    for source in (examples, tmp_path / "a.npz", tmp_path / "a.h5"):
        loaded = load_examples(source, learner)
        np.testing.assert_array_equal(loaded["image"], examples["image"].transpose(0, 3, 1, 2))
        np.testing.assert_array_equal(loaded["state"], examples["state"])
    assert load_examples(examples["state"].astype(np.float64), STATES).dtype == np.float32
    with pytest.raises(DatasetError, match="examples/state: holds 3 examples, but other keys hold 4"):
        load_examples({**examples, "state": examples["state"][:3]}, learner)
    with pytest.raises(DatasetError, match=r"hold \['image'\] and lack \['state'\].*example_keys"):
        load_examples({"image": examples["image"]}, learner, ["image", "state"])


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (FRAMES[:0], "holds no example"),
        (FRAMES / 255, "has dtype float64, expected uint8.*255"),
        (FRAMES // 255, "holds only the values 0 and 1. Multiply"),
        (FRAMES[:, :4], r"has shape \(5, 4, 6, 3\), expected \(n, 8, 6, 3\)"),
        (FRAMES[0], r"has shape \(8, 6, 3\), expected"),
        (FRAMES.astype(np.int64) + 200, "holds values in .* outside of the range"),
        ([FRAMES[0].tolist(), FRAMES[0, :4].tolist()], "examples: is no array"),
    ],
)
def test_unfit_arrays(tmp_path, source, message):
    with pytest.raises(DatasetError, match=message):
        load_examples(source, IMAGES)


@pytest.mark.parametrize(
    ("space", "row"), [(spaces.Discrete(3, start=1), 4), (spaces.MultiDiscrete([2, 3]), [2, 0]), (spaces.Discrete(3), -1)]
)
def test_invalid_choices(space, row):
    with pytest.raises(DatasetError, match=r"examples: holds .* in row 1, which is not in (Multi)?Discrete"):
        load_examples(np.array([space.sample(), row]), space)


def test_unfit_files(tmp_path):
    def fails(source, message, space=IMAGES):
        with pytest.raises(DatasetError, match=message) as caught:
            load_examples(source, space)
        assert str(source) in str(caught.value)

    fails(tmp_path / "none.npz", "file: does not exist")
    fails(tmp_path, "holds no .png")
    fails(tmp_path, "holds images, but the observation space is Box.*float32", STATES)
    (tmp_path / "a.npz").write_bytes(b"zip?")
    fails(tmp_path / "a.npz", "cannot be read")
    np.savez(tmp_path / "b.npz", a=FRAMES, b=FRAMES)
    for name, content in {"cut": (tmp_path / "b.npz").read_bytes()[:-40], "empty": b""}.items():
        (tmp_path / f"{name}.npz").write_bytes(content)
        fails(tmp_path / f"{name}.npz", "cannot be read")
    np.savez(tmp_path / "objects.npz", np.array([None]))
    fails(tmp_path / "objects.npz", "cannot be read")
    fails(tmp_path / "b.npz", "holds the arrays .*'a', 'b'.*Rename")
    write_dataset(tmp_path / "d.h5")
    fails(tmp_path / "d.h5", "is 'sb3-offline-dataset' version 1, expected 'sb3-offline-examples'.*Extract")
    (tmp_path / "x.png").write_bytes(b"PNG?")
    with pytest.raises(DatasetError, match=r"x.png: image: cannot be read"):
        load_examples(tmp_path, IMAGES)
    Image.fromarray(np.full((8, 6), 40_000, np.uint16)).save(tmp_path / "x.png")
    with pytest.raises(DatasetError, match=r"x.png: image: has Pillow's mode I;16.*8 bits"):
        load_examples(tmp_path, IMAGES)


@pytest.mark.parametrize("space", [IMAGES, BOTH])
def test_extracted_are_observations_after_successful_steps(tmp_path, space):
    episodes = write_dataset(tmp_path / "a.h5", 15, space) + write_dataset(tmp_path / "b.h5", 15, space, first=15)
    wanted = set()
    for episode in episodes:
        if episode["source"] == "left":
            observations = episode["observations"]["image"] if space is BOTH else episode["observations"]
            wanted |= {observations[t + 1].tobytes() for t in np.flatnonzero(episode["success"])}
    pattern = str(tmp_path / "?.h5")
    examples, provenance = extract_examples(pattern, len(wanted), source="left", held_out=True)
    assert {frame.tobytes() for frame in (examples["image"] if space is BOTH else examples)} == wanted
    assert provenance["held_out"] is True and [origin["file"] for origin in provenance["datasets"]] == ["a.h5", "b.h5"]
    assert all(episode % 2 for episode in provenance["datasets"][0]["episodes"])
    with pytest.raises(DatasetError, match=rf"success: holds {len(wanted)} steps with success of source 'left'"):
        extract_examples(pattern, len(wanted) + 1, source="left")
    with pytest.raises(DatasetError, match=r"source: has no 'up'. The sources are"):
        extract_examples(pattern, 1, source="up")


def test_extraction_is_seeded_and_does_not_depend_on_storage(tmp_path):
    write_dataset(tmp_path / "a.h5", 30)
    convert(tmp_path / "a.h5", tmp_path / "small.h5", "compressed", progress_bar=False)
    first, again, small, other = (
        extract_examples(tmp_path / name, 9, seed=seed)[0]
        for name, seed in (("a.h5", 0), ("a.h5", 0), ("small.h5", 0), ("a.h5", 1))
    )
    assert (first == again).all() and (first == small).all() and (first != other).any()


def test_extraction_program(tmp_path, capsys):
    write_dataset(tmp_path / "a.h5", 30)
    command = ["examples", str(tmp_path / "a.h5"), "-o", str(tmp_path / "e.h5"), "-n", "7", "--held-out"]
    cli.main(command)
    assert "7 examples from" in capsys.readouterr().out
    examples, provenance = extract_examples(OfflineDataset(tmp_path / "a.h5"), 7, held_out=True)
    np.testing.assert_array_equal(load_examples(tmp_path / "e.h5", IMAGES), examples)
    with h5py.File(tmp_path / "e.h5") as file:
        assert json.loads(file.attrs["provenance"]) == provenance
    with pytest.raises(SystemExit, match=r"exists already. Give --overwrite"):
        cli.main(command)
