"""Runs, grids, configs and reports: locks, names, damaged files of one run, full disks, and what reaches the terminal."""

import errno
import json
import os
import zipfile
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from data_files import ACTIONS, STATES, make_episode, write_dataset

from sb3_offline.benchmark import table, worker
from sb3_offline.benchmark.grid import Grid, GridRun, Method
from sb3_offline.benchmark.runner import DAMAGED_MODEL, _set_damaged_models_aside
from sb3_offline.cli import main
from sb3_offline.data import disk
from sb3_offline.data.convert import convert
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.experiment.config import load_config
from sb3_offline.experiment.run import MODEL_FILE, RunInUseError, TrainingRun, locked_run


def test_a_second_run_in_the_same_folder_is_refused(tmp_path):
    write_dataset(tmp_path / "d.h5", space=STATES)
    train = ["train", "--algo", "bc", "--env", "Pendulum-v1", "--dataset", str(tmp_path / "d.h5"), "-n", "2"]
    with locked_run(tmp_path / "run"):
        holder = rf"run: folder: is in use by another process \(process {os.getpid()} on .* since .*name another folder"
        with pytest.raises(SystemExit, match=holder):
            main([*train, "-o", str(tmp_path / "run")])
    assert not (tmp_path / "run").exists()  # neither wrote anything
    main([*train, "-o", str(tmp_path / "run")])
    assert sorted(os.listdir(tmp_path / "run")) == ["config.yml", "model.zip"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("default:\n  policy: MlpPolicy\n  gamma: 0.9\n  n_timesteps: 5\n  gamma: 0.8\n", r"'gamma' is there twice.*line 5"),
        ("default: &d\n  policy: MlpPolicy\ndefault: 3\n", "'default' is there twice"),
        ("default:\n  policy: MlpPolicy\n  n_timesteps: 5\n  learning_rate: .inf\n", r"\.inf is no finite number.*line 4"),
        ("default:\n  policy: MlpPolicy\n  n_timesteps: 5\n  gamma: .NaN\n", r"\.NaN is no finite number"),
        ("default: [\n", "is not YAML"),
        ("a\0b: 1", "is not YAML"),
    ],
)
def test_configs_are_read_as_they_are_meant_or_refused(tmp_path, text, message):
    (tmp_path / "c.yml").write_text(text)
    with pytest.raises(RuntimeError, match=message) as caught:
        load_config(str(tmp_path / "c.yml"), "Pendulum-v1")
    assert "c.yml" in str(caught.value) and "\n" not in str(caught.value)


def a_grid(**changes):
    arguments = {"methods": {"bc": Method("bc", "bc")}, "tasks": ["t"], "seeds": [0], "n_timesteps": 10, "dataset": "d.h5"}
    return Grid(**{"env": "Pendulum-v1", **arguments, **changes})


@pytest.mark.parametrize("name", ["../../../X", "..", "", "a/b", "a\\b", "a\x1b[2J", "C:x"])
def test_names_of_a_grid_stay_in_its_folder(name):
    with pytest.raises(RuntimeError, match=r"tasks: .* names files"):
        a_grid(tasks=["t", name])
    with pytest.raises(RuntimeError, match=r"methods: .* names files"):
        a_grid(methods={name: Method("bc", "bc")})


def test_words_of_a_file_do_not_steer_the_terminal(tmp_path, capsys):
    with DatasetWriter(tmp_path / "d.h5", STATES, ACTIONS, provenance={"policy": "a\x1b[2Jb"}, sources=["c\x1b[2J"]) as writer:
        writer.add_episode(**{**make_episode(0, STATES), "extras": None, "source": "c\x1b[2J"})
    main(["inspect", str(tmp_path / "d.h5")])
    out = capsys.readouterr().out
    assert "\x1b" not in out and "a\\x1b[2Jb" in out
    with pytest.raises(SystemExit) as ended:
        main(["train", "--algo", "bc\x1b[2J", "-o", str(tmp_path / "run")])
    assert "\x1b" not in str(ended.value)


def test_the_file_inside_a_minari_dataset_may_not_borrow(tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    write_dataset(tmp_path / "d.h5", 2, space=STATES)
    convert(tmp_path / "d.h5", "minari:test/d-v0")
    (inner,) = (tmp_path / "minari").rglob("main_data.hdf5")
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["x"] = np.zeros((3, 2), np.float32)
    with h5py.File(inner, "r+") as file:
        del file["episode_0/actions"]
        file["episode_0/actions"] = h5py.ExternalLink(str(tmp_path / "secret.h5"), "x")
    with pytest.raises(DatasetError, match=r"main_data.hdf5: episode_0/actions: is a link to another file"):
        OfflineDataset("minari:test/d-v0")


def test_a_figure_that_fails_leaves_the_old_one(tmp_path):
    pytest.importorskip("rliable")
    from sb3_offline.report import figures

    figure = figures.plt.figure()
    figures._save(figure, tmp_path / "f.png")
    before = (tmp_path / "f.png").read_bytes()
    assert before.startswith(b"\x89PNG")
    figure.savefig = lambda path, **kwargs: (path.write_text("half"), 1 / 0)
    with pytest.raises(ZeroDivisionError):
        figures._save(figure, tmp_path / "f.png")
    assert (tmp_path / "f.png").read_bytes() == before and os.listdir(tmp_path) == ["f.png"]


# --- One damaged file of one run, and a full disk ---


@pytest.fixture
def run(tmp_path):
    training = TrainingRun("bc", "Pendulum-v1", {"n_timesteps": 10}, tmp_path / "run", dataset="d.h5", save_freq=5)
    (tmp_path / "run").mkdir()
    return GridRun("bc t seed 0", ("t",), training, a_grid())


def test_a_damaged_model_starts_its_run_again_and_no_other(tmp_path):
    runs = [SimpleNamespace(folder=tmp_path / name) for name in ("whole", "damaged", "new")]
    for one in runs:
        one.folder.mkdir()
    for one in runs[:2]:
        with zipfile.ZipFile(one.folder / MODEL_FILE, "w") as archive:
            archive.writestr("data", b"x" * 100)
    raw = bytearray((runs[1].folder / MODEL_FILE).read_bytes())
    raw[60] ^= 1
    (runs[1].folder / MODEL_FILE).write_bytes(raw)
    (message,) = _set_damaged_models_aside(runs)
    assert "damaged/model.zip: is damaged (data), so this run starts again" in message
    assert [sorted(os.listdir(one.folder)) for one in runs] == [[MODEL_FILE], [DAMAGED_MODEL], []]


def test_damaged_notes_of_a_run_do_not_stop_the_table(run):
    for name in (worker.FAILURE_FILE, worker.PROVENANCE_FILE):
        (run.folder / name).write_text('{"error": "x')
    with pytest.warns(UserWarning, match=r"failure.json: is damaged"):
        assert table.failure_of(run) is None
    worker.record_failure(run, "broke")
    with pytest.warns(UserWarning, match=r"provenance.json: is damaged"):
        row, *_ = table.table_rows({("bc", "t", 0): run})
    assert row["config"] == "bc (failed: broke)" and row["commit"] == ""


def test_a_full_disk_pauses_a_run_with_one_line(run, monkeypatch, capsys):
    room, tries = iter([10**9, 0, 0, 10**9]), []

    def train_run(training, **kwargs):
        tries.append(training)
        if len(tries) == 1:
            try:
                raise OSError(errno.ENOSPC, "No space left on device")
            except OSError as error:
                raise RuntimeError("cannot be saved") from error

    monkeypatch.setattr(worker, "train_run", train_run)
    monkeypatch.setattr(disk, "free_bytes", lambda folder: next(room))
    monkeypatch.setattr(disk.time, "sleep", lambda seconds: None)
    worker.complete_run(run)
    assert len(tries) == 2 and not (run.folder / worker.FAILURE_FILE).exists()
    assert capsys.readouterr().out.count("the disk is full. Paused until") == 1


def test_a_run_in_use_is_no_failure(run, monkeypatch):
    def train_run(training, **kwargs):
        raise RunInUseError("run", "folder", "is in use", "Wait")

    monkeypatch.setattr(worker, "train_run", train_run)
    with pytest.raises(RunInUseError):
        worker.complete_run(run)
    assert not (run.folder / worker.FAILURE_FILE).exists()
    monkeypatch.setattr(worker, "train_run", lambda *args, **kwargs: (_ for _ in ()).throw(ValueError("wrong")))
    worker.complete_run(run)
    assert json.loads((run.folder / worker.FAILURE_FILE).read_text())["error"] == "ValueError: wrong"
