"""Nothing is lost and nothing is let in: locks, whole outputs, files that claim what they do not hold, and pickled code."""

import base64
import io
import json
import multiprocessing
import os
import pickle
import shutil
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from data_files import ACTIONS, IMAGES, OPTIONS, STATES, make_episode, write_dataset
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import save_to_pkl

from sb3_offline.cli import main
from sb3_offline.data.convert import convert
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import load_examples, save_examples
from sb3_offline.data.files import WriteLock, check_outputs, replacing
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.experiment.run import CONFIG_FILE, MODEL_FILE
from sb3_offline.experiment.training import load_run, train


def edited(path, change):
    with h5py.File(path, "r+") as file:
        change(file)
    return path


def put(name, value, **kwargs):
    def change(file):
        if name in file:
            del file[name]
        file.create_dataset(name, data=value, **kwargs)

    return change


# --- Locks ---


def ask_again_and_again(path, stop):
    while not stop.is_set():
        try:
            DatasetWriter(path, IMAGES, ACTIONS, **OPTIONS, mode="a").close()
        except DatasetError:
            pass


def test_a_writer_is_not_disturbed_by_processes_that_ask_for_its_file(tmp_path):
    context = multiprocessing.get_context("forkserver")
    stop, path = context.Event(), tmp_path / "d.h5"
    with DatasetWriter(path, IMAGES, ACTIONS, **OPTIONS, capacity=(2, 20)) as writer:
        process = context.Process(target=ask_again_and_again, args=(path, stop))
        process.start()
        for index in range(30):  # outgrows its room again and again, so that the file is replaced
            writer.add_episode(**make_episode(index))
            with pytest.raises(DatasetError, match=rf"written by another process \(process {os.getpid()} on .* since"):
                DatasetWriter(path, IMAGES, ACTIONS, **OPTIONS, mode="w")
            with pytest.raises(DatasetError, match="written by another process"):
                convert(path, path, overwrite=True, progress_bar=False)
    stop.set()
    process.join()
    assert OfflineDataset(path).seeds.tolist() == [make_episode(index)["seed"] for index in range(30)]
    assert os.listdir(tmp_path) == ["d.h5"]


def test_a_conversion_in_place_loses_no_episode_that_came_meanwhile(tmp_path, monkeypatch):
    path = tmp_path / "d.h5"
    write_dataset(path, 2)
    opened = OfflineDataset(path)
    lock = WriteLock

    def late_lock(*args, **kwargs):  # another writer is faster
        monkeypatch.setattr("sb3_offline.data.convert.WriteLock", lock)
        with DatasetWriter(path, IMAGES, ACTIONS, **OPTIONS, mode="a") as writer:
            writer.add_episode(**make_episode(writer.n_episodes))
        return lock(*args, **kwargs)

    monkeypatch.setattr("sb3_offline.data.convert.WriteLock", late_lock)
    convert(path, path, overwrite=True, progress_bar=False)
    assert OfflineDataset(path).n_episodes == 3
    with pytest.raises(DatasetError, match="was written to by another process after it was opened"):
        convert(opened, path, overwrite=True, progress_bar=False)
    assert OfflineDataset(path).n_episodes == 3


def test_leftovers_of_killed_writers_are_removed_and_permissions_stay(tmp_path):
    path = tmp_path / "d.h5"
    for name in (".d.h5.tmp", ".d.h5.17.0123abcd.tmp", "..d.h5.17.0123abcd.tmp.lock", ".d.h5.lock"):
        (tmp_path / name).write_text("left")
    (tmp_path / ".other.h5.17.0123abcd.tmp").write_text("of another file")
    path.write_text("old")
    path.chmod(0o640)
    with replacing(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert sorted(os.listdir(tmp_path)) == [".other.h5.17.0123abcd.tmp", "d.h5"]
    assert path.read_text() == "new" and path.stat().st_mode & 0o777 == 0o640
    with WriteLock(path), pytest.raises(DatasetError, match="is being written"):
        WriteLock(path)


# --- Whole or not at all, and never over an input ---


def test_a_writer_that_fails_before_its_first_episode_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), DatasetWriter(tmp_path / "d.h5", IMAGES, ACTIONS):
        raise KeyboardInterrupt
    assert os.listdir(tmp_path) == []


def test_a_minari_dataset_appears_whole_or_not_at_all(tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    write_dataset(tmp_path / "d.h5", 2, space=STATES)
    (tmp_path / "minari/.test%d-v0.tmp").mkdir(parents=True)  # of a killed process
    with monkeypatch.context() as patch:
        patch.setattr("sb3_offline.data.foreign.minari._metadata", lambda header: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            convert(tmp_path / "d.h5", "minari:test/d-v0")
    assert list((tmp_path / "minari").rglob("*")) == []
    convert(tmp_path / "d.h5", "minari:test/d-v0")
    assert OfflineDataset("minari:test/d-v0").n_episodes == 2
    assert sorted(os.listdir(tmp_path / "minari")) == ["test"] and os.environ["MINARI_DATASETS_PATH"] == str(
        tmp_path / "minari"
    )


def test_outputs_are_compared_with_inputs_by_file_and_not_by_name(tmp_path):
    (tmp_path / "folder").mkdir()
    original = tmp_path / "folder/a.h5"
    original.write_text("data")
    os.link(original, tmp_path / "hard.h5")
    os.symlink(original, tmp_path / "soft.h5")
    for given in (original, original.parent):
        for name in ("folder/a.h5", "hard.h5", "soft.h5"):
            with pytest.raises(DatasetError, match="is read by this very command"):
                check_outputs([tmp_path / name], [np.zeros(3), None, given])
    check_outputs([tmp_path / "new.h5", tmp_path / "folder/b.h5"], [original.parent])


def test_commands_refuse_to_write_over_what_they_read(tmp_path):
    write_dataset(tmp_path / "d.h5")
    os.link(tmp_path / "d.h5", tmp_path / "same.h5")
    before = (tmp_path / "d.h5").read_bytes()
    for arguments in (
        ["inspect", "d.h5", "--html", "same.h5"],
        ["examples", "d.h5", "-o", "same.h5", "--overwrite", "-n", "1"],
    ):
        with pytest.raises(SystemExit, match="is read by this very command"):
            main([str(tmp_path / text) if text.endswith(".h5") else text for text in arguments])
    assert (tmp_path / "d.h5").read_bytes() == before


# --- Files that claim what they do not hold ---


def external(file):
    del file["rewards"]
    file.create_dataset("rewards", (10,), "f4", external=[(str(Path(file.filename).with_name("secret")), 0, 40)])


def virtual(file):
    del file["rewards"]
    layout = h5py.VirtualLayout((10,), "f4")
    layout[:] = h5py.VirtualSource("plain.h5", "rewards", (10,))
    file.create_virtual_dataset("rewards", layout)


def link(name, target):
    def change(file):
        del file[name]
        file[name] = target

    return change


def undeclared(file):
    del file["rewards"]
    file.create_dataset("rewards", (10**13,), "f4", chunks=(1000,))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (external, "rewards: is stored in another file"),
        (virtual, "rewards: is a virtual dataset"),
        (link("rewards", h5py.ExternalLink("plain.h5", "rewards")), "rewards: is a link to another file"),
        (link("rewards", h5py.SoftLink("/extras/qpos")), "rewards: is a link to another place"),
        (link("episodes", h5py.ExternalLink("plain.h5", "episodes")), "episodes: is a link to another file"),
        (link("extras", h5py.ExternalLink("plain.h5", "extras")), "extras: is a link to another file"),
        (undeclared, "rewards: declares .* which the file does not hold"),
        (put("extras/p", np.zeros(10, dtype=[("a", "f4"), ("b", "i4")])), "extras/p: has rows of shape .* and dtype"),
        (lambda f: put("extras/p", np.array([f.ref] * 10, dtype=h5py.ref_dtype))(f), "extras/p: has rows .* dtype object"),
        (put("episodes/length", 5), "episodes/length: has shape .*one integer for each episode"),
        (put("episodes/length", np.array([2**62, 2**62])), "episodes/length: adds up to more steps"),
        (put("rewards", 1.0), "rewards: holds a single value"),
        (put("n_episodes", 1.5), "n_episodes: has shape .*expected one integer"),
        (lambda f: f.attrs.__setitem__("provenance", "[1]"), "attribute provenance: cannot be understood"),
        (lambda f: f.attrs.__setitem__("sources", '["a", "a"]'), "attribute sources: cannot be understood .*twice"),
        (
            lambda f: f.attrs.__setitem__(
                "observation_space", '{"type": "Box", "shape": [1000000000000], "dtype": "float32", "low": 0, "high": 1}'
            ),
            "attribute observation_space: cannot be understood .*too large",
        ),
        (lambda f: f.attrs.__setitem__("format", np.zeros(3)), "file: has no known format"),
    ],
)
def test_a_dataset_that_borrows_or_misdeclares_is_refused(tmp_path, change, message):
    (tmp_path / "secret").write_bytes(b"0123456789" * 100)
    write_dataset(tmp_path / "plain.h5", 2)
    shutil.copy(tmp_path / "plain.h5", tmp_path / "d.h5")
    edited(tmp_path / "d.h5", change)
    with pytest.raises(DatasetError, match=f"d.h5: {message}") as caught:
        OfflineDataset(tmp_path / "d.h5")
    assert "\n" not in str(caught.value)
    before = (tmp_path / "d.h5").read_bytes()
    with pytest.raises(DatasetError):
        DatasetWriter(tmp_path / "d.h5", IMAGES, ACTIONS, **OPTIONS, mode="a")
    assert (tmp_path / "d.h5").read_bytes() == before


def test_examples_and_files_of_others_may_not_borrow_either(tmp_path):
    (tmp_path / "secret").write_bytes(b"0123456789" * 100)
    save_examples(tmp_path / "e.h5", np.zeros((4, 3), np.float32), STATES)
    edited(
        tmp_path / "e.h5",
        lambda f: (
            f.__delitem__("observations"),
            f.create_dataset("observations", (4, 3), "f4", external=[(str(tmp_path / "secret"), 0, 48)]),
        ),
    )
    with pytest.raises(DatasetError, match=r"e.h5: observations: is stored in another file"):
        load_examples(tmp_path / "e.h5", STATES)
    with h5py.File(tmp_path / "d4rl.h5", "w") as file:
        for name, shape in (("actions", (10, 2)), ("terminals", (10,)), ("timeouts", (10,)), ("rewards", (10,))):
            file[name] = np.zeros(shape, np.float32)
        file.create_dataset("observations", (10, 3), "f4", external=[(str(tmp_path / "secret"), 0, 120)])
    with pytest.raises(DatasetError, match=r"d4rl.h5: observations: is stored in another file"):
        OfflineDataset(tmp_path / "d4rl.h5")


def test_words_of_a_file_cannot_steer_the_terminal():
    assert str(DatasetError("a\x1b[2J.h5", "field", "is\n\x07 bad", "Go")) == "a\\x1b[2J.h5: field: is \\x07 bad. Go."


def test_choices_are_checked_when_written_and_when_read(tmp_path):
    choices = spaces.Discrete(3)
    with DatasetWriter(tmp_path / "d.h5", choices, choices, rewards=False, success=False) as writer:
        writer.add_episode(np.array([0, 1, 2]), np.array([0, 2]))
        with pytest.raises(DatasetError, match="actions: holds 3 in row 1, which is not in Discrete"):
            writer.add_episode(np.array([0, 1, 2]), np.array([0, 3]))
        with pytest.raises(DatasetError, match="truncated: is true in a step that also terminates"):
            ends = np.array([False, True])
            writer.add_episode(np.array([0, 1, 2]), np.array([0, 2]), terminated=ends, truncated=ends)
    edited(shutil.copy(tmp_path / "d.h5", tmp_path / "ends.h5"), lambda file: file["terminated"].__setitem__(1, True))
    with pytest.raises(DatasetError, match=r"ends.h5: truncated: is true in a step that also terminates \(row 1\)"):
        OfflineDataset(tmp_path / "ends.h5")
    for name, row in (("actions", 1), ("observations", 2)):
        shutil.copy(tmp_path / "d.h5", tmp_path / "bad.h5")
        edited(tmp_path / "bad.h5", lambda file, name=name, row=row: file[name].__setitem__(row, 7))
        with pytest.raises(DatasetError, match=f"bad.h5: {name}: holds 7 in row {row}, which is not in Discrete"):
            OfflineDataset(tmp_path / "bad.h5")


@pytest.mark.parametrize("declared", [((), object), ((), "S"), ((), [("a", "f4")]), ((), "U5"), ((-1,), "f4"), (("a",), "f4")])
def test_extras_that_a_file_cannot_hold_are_refused_when_they_are_declared(tmp_path, declared):
    with pytest.raises(DatasetError, match=r"d.h5: extras/p: "):
        DatasetWriter(tmp_path / "d.h5", IMAGES, ACTIONS, extras={"p": declared})
    with pytest.raises(DatasetError, match="is no name of an array"):
        DatasetWriter(tmp_path / "d.h5", IMAGES, ACTIONS, extras={"a/b": ((), "f4")})
    assert os.listdir(tmp_path) == []


# --- Consent ---


class Evil:
    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def test_pickles_are_opened_only_if_they_run_no_code_or_with_consent(tmp_path):
    buffer = ReplayBuffer(20, STATES, ACTIONS, "cpu")
    for step in range(10):
        buffer.add(np.full(3, step), np.full(3, step + 1), np.zeros(2), np.zeros(1), np.array([step == 9]), [{}])
    save_to_pkl(tmp_path / "good.pkl", buffer)
    assert OfflineDataset(tmp_path / "good.pkl").n_steps == 10
    buffer.rewards = Evil(tmp_path / "ran")
    with (tmp_path / "bad.pkl").open("wb") as file:
        pickle.dump(buffer, file)
    with pytest.raises(SystemExit, match=r"bad.pkl: file: is a pickle, which may run any code .*mkdir.*--trust"):
        main(["inspect", str(tmp_path / "*.pkl")])
    assert not (tmp_path / "ran").exists()
    with pytest.raises(Exception):  # noqa: B017 the buffer is no good, but its code ran, as was agreed to
        OfflineDataset(tmp_path / "bad.pkl", trust=True)
    assert (tmp_path / "ran").exists()


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    write_dataset(folder / "d.h5", space=STATES)
    train("bc", "Pendulum-v1", short_config(4), folder / "run", dataset=str(folder / "d.h5"), progress_bar=False)
    return folder


def short_config(n_timesteps):
    return {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "n_timesteps": n_timesteps}


def test_a_model_runs_no_code_without_consent(finished_run, tmp_path):
    model_file = finished_run / "run" / MODEL_FILE
    load_run(model_file)
    shutil.copytree(finished_run / "run", tmp_path / "run")
    with zipfile.ZipFile(model_file) as source, zipfile.ZipFile(tmp_path / "run" / MODEL_FILE, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "data":
                data = json.loads(content)
                stream = io.BytesIO()
                pickle.dump(Evil(tmp_path / "ran"), stream)
                data["policy_class"] = {":type:": "x", ":serialized:": base64.b64encode(stream.getvalue()).decode()}
                content = json.dumps(data).encode()
            target.writestr(name, content)
    with pytest.raises(SystemExit, match=r"model.zip: policy_class: is a pickle, which may run any code .*--trust"):
        main(["evaluate", str(tmp_path / "run" / MODEL_FILE)])
    assert not (tmp_path / "ran").exists()
    shutil.copy(model_file, tmp_path / "run" / MODEL_FILE)
    (tmp_path / "evil_module.py").write_text("raise SystemExit('ran')")
    config = tmp_path / "run" / CONFIG_FILE
    config.write_text(config.read_text().replace("Pendulum-v1", "evil_module:Pendulum-v1"))
    with pytest.raises(SystemExit, match=r"runs the module evil_module; .*--trust"):
        main(["evaluate", str(tmp_path / "run" / MODEL_FILE)])


def test_training_does_not_write_over_its_data(finished_run, tmp_path):
    os.link(finished_run / "d.h5", tmp_path / "evaluations.csv")
    before = (finished_run / "d.h5").read_bytes()
    with pytest.raises(SystemExit, match=r"evaluations.csv: file: is read by this very command"):
        main(["train", "--algo", "bc", "--dataset", str(finished_run / "*.h5"), "-n", "2", "-o", str(tmp_path)])
    assert (finished_run / "d.h5").read_bytes() == before and os.listdir(tmp_path) == ["evaluations.csv"]


# --- Training over a finished run ---


def test_a_finished_run_stays_until_the_new_model_is_whole(finished_run, tmp_path, monkeypatch):
    folder, data = tmp_path / "run", str(finished_run / "d.h5")
    shutil.copytree(finished_run / "run", folder)
    (folder / "evaluations.csv").write_text("an earlier table")
    old = {name: (folder / name).read_bytes() for name in (MODEL_FILE, CONFIG_FILE)}
    with monkeypatch.context() as patch:
        patch.setattr("sb3_offline.bc.bc.BC.train", lambda *args, **kwargs: (_ for _ in ()).throw(KeyboardInterrupt))
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                train("bc", "Pendulum-v1", short_config(6), folder, dataset=data, progress_bar=False)
            assert {name: (folder / name).read_bytes() for name in old} == old
            assert (folder / "earlier_evaluations.csv").read_text() == "an earlier table"
    train("bc", "Pendulum-v1", short_config(6), folder, dataset=data, progress_bar=False)
    model, config = load_run(folder / MODEL_FILE)
    assert (model.num_timesteps, config["n_timesteps"]) == (6, 6)
    assert sorted(os.listdir(folder)) == [CONFIG_FILE, MODEL_FILE]
