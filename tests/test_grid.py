"""A grid of runs has the same table whether or not processes are killed."""

import contextlib
import csv
import json
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from stable_baselines3.common.callbacks import BaseCallback

pytest.importorskip("metaworld")

from grids import GRID, assert_same, collect_data, rows_of, write_grid

from sb3_offline import cli
from sb3_offline.benchmark import local
from sb3_offline.benchmark.grid import load_grid, plan
from sb3_offline.benchmark.local import train_locally
from sb3_offline.benchmark.table import table_writer
from sb3_offline.benchmark.worker import LOCK_FILE, _Provenance, complete_run, record_failure
from sb3_offline.common.provenance import current_commit
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.experiment.policy_file import load_policy
from sb3_offline.experiment.run import TrainingRun
from sb3_offline.experiment.training import RESUME_FILE, load_run, train_run
from sb3_offline.report.results import read_results, with_early_checkpoints

TABLE = "evaluations-door-open.csv"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return collect_data(tmp_path_factory.mktemp("data"))


def run_benchmark(folder, grid, *options, fails=False):
    arguments = ["--runs", str(folder / "runs"), "-o", str(folder / "table.csv"), "--workers", "1", *options]
    with pytest.raises(SystemExit, match=r"runs failed; .*table.csv says why") if fails else contextlib.nullcontext():
        cli.main(["benchmark", grid, *arguments])
    with (folder / "table.csv").open() as file:
        return list(csv.DictReader(file))


def kill_once(run, file, n_lines, done):
    """Kill the process of a run as soon as one of its files has this number of lines."""
    while not done.is_set():
        path = run.folder / file
        if path.exists() and path.read_bytes().count(b"\n") >= n_lines:
            os.kill(int((run.folder / LOCK_FILE).read_text()), signal.SIGKILL)
            return
        time.sleep(0.002)
    raise AssertionError(f"{run.label} was not killed")


def test_killed_runs_end_like_others(data, tmp_path):
    grid = load_grid(write_grid(tmp_path, data, n_timesteps=200))
    chosen = grid.cells(["ceborl", "cql"], ["door-open"])
    whole, killed = (plan(grid, tmp_path / name, chosen) for name in ("whole", "killed"))
    for run in whole.values():
        complete_run(run)
    ceborl, cql = killed.values()
    done = threading.Event()
    with ThreadPoolExecutor() as pool:
        # One is killed after its first save, the other after its first evaluation, perhaps before it saved that step
        kills = [pool.submit(kill_once, ceborl, RESUME_FILE, 0, done), pool.submit(kill_once, cql, TABLE, 2, done)]
        assert len(list(train_locally([ceborl, cql], n_workers=2))) == 2
        done.set()
        for kill in kills:
            kill.result()
    assert rows_of(killed) == rows_of(whole) and len(rows_of(whole)) == 4
    for one, other in zip(killed.values(), whole.values(), strict=True):
        assert_same(*(load_run(run.folder / "model.zip")[0].get_parameters() for run in (one, other)))
        assert [file.name for file in sorted(one.folder.iterdir())] == [file.name for file in sorted(other.folder.iterdir())]


class _Interruption(BaseCallback):
    """Stops a run at a step, and records the step where it began."""

    def __init__(self, step):
        super().__init__()
        self.step, self.began = step, -1

    def _on_training_start(self):
        self.began = self.num_timesteps

    def _on_step(self):
        if self.num_timesteps == self.step:
            raise KeyboardInterrupt
        return True


def test_a_run_goes_on_from_its_last_save(data, tmp_path):
    grid = load_grid(write_grid(tmp_path, data))
    (run,) = plan(grid, tmp_path / "runs", grid.cells(["ceborl"], ["door-open"])).values()
    stops, goes_on = _Interruption(28), _Interruption(None)
    with pytest.raises(KeyboardInterrupt):
        train_run(run.training, progress_bar=False, callbacks=[stops])
    train_run(run.training, progress_bar=False, callbacks=[goes_on])
    assert (stops.began, goes_on.began) == (0, 25)


def test_a_run_knows_its_chosen_episodes_again(data):
    def record(episodes):
        dataset = OfflineDataset(data["dataset"]).select(episodes)
        return TrainingRun("bc", "x", {}, Path("run"), dataset=dataset, examples=np.arange(2000)).record()

    assert record([0, 1]) == record([0, 1]) != record([0, 2])


def test_a_run_that_goes_on_with_other_code_says_so(tmp_path):
    provenance = _Provenance(tmp_path / "provenance.json")
    for step, before, expected in ((5, "a", "a then NOW"), (5, "a then NOW", "a then NOW"), (0, "a", "NOW")):
        provenance.path.write_text(json.dumps({"commit": before.replace("NOW", current_commit())}))
        provenance.num_timesteps = step
        provenance._on_training_start()
        assert json.loads(provenance.path.read_text())["commit"] == expected.replace("NOW", current_commit())


def test_a_failure_is_a_row_and_stops_nothing(data, tmp_path):
    methods = {"wrong": {"algo": "bc", "config": "bc", "changes": {"batch_size": "many"}}, **GRID["methods"]}
    grid = write_grid(tmp_path, data, methods=methods)
    options = ["--methods", "wrong", "bc", "ceborl", "--tasks", "door-open"]
    rows = run_benchmark(tmp_path, grid, *options, fails=True)
    assert [(row["method"], row["step"], row["episodes"]) for row in rows] == [
        (name, step, "1") for name in ("bc", "ceborl", "wrong") for step in ("30", "40")
    ]
    assert all(row["config"].startswith("bc batch_size=many (failed: ") and row["successes"] == "0" for row in rows[4:])
    assert rows[0]["config"] == "bc" and rows[0]["commit"] and rows[0]["versions"].startswith("torch ")
    model = tmp_path / "runs/ceborl/door-open-seed3/model.zip"
    before = model.stat().st_mtime_ns
    again = run_benchmark(tmp_path, grid, *options, fails=True)
    for row in [*rows, *again]:
        del row["commit"]  # the failed run was tried again, perhaps at another commit
    assert again == rows and model.stat().st_mtime_ns == before
    # Writing a part of the grid keeps the rows of the other cells, in both files
    curves = (tmp_path / "table_curves.csv").read_text()
    assert [line.split(",")[:4] for line in curves.splitlines()[1:]] == [
        [name, "door-open", "3", step] for name in ("bc", "ceborl") for step in ("10", "20", "30", "40")
    ]
    part = run_benchmark(tmp_path, grid, "--no-training", "--methods", "bc", "--tasks", "door-open")
    for row in part:
        del row["commit"]
    assert part == rows and (tmp_path / "table_curves.csv").read_text() == curves
    # Other hyperparameters make another run, which the table shows once it is finished
    methods["ceborl"] = {**methods["ceborl"], "changes": {"batch_size": 5}}
    grid = write_grid(tmp_path, data, methods=methods)
    assert [row["method"] for row in run_benchmark(tmp_path, grid, "--no-training", *options)] == ["bc"] * 2 + ["wrong"] * 2


def test_a_run_that_no_task_affects_is_trained_once(data, tmp_path, capsys):
    grid = write_grid(tmp_path, data)
    rows = run_benchmark(tmp_path, grid, "--methods", "bc")
    assert "of 4 episodes solved" in capsys.readouterr().out  # two tasks, two checkpoints that count
    assert [(row["task"], row["step"]) for row in rows] == [(task, step) for task in GRID["tasks"] for step in ("30", "40")]
    assert [path.name for path in (tmp_path / "runs/bc").iterdir()] == ["seed3"]
    cells = plan(load_grid(grid), tmp_path / "runs")
    assert cells["bc", "door-open", 3] is cells["bc", "drawer-open", 3]
    assert cells["cql", "door-open", 3] is not cells["cql", "drawer-open", 3]
    tables = cells["bc", "door-open", 3].tables()
    assert [list(table.seeds) for table in tables] == [[104_002, 104_003, 104_000, 104_001]] * 2
    assert [table.env_kwargs["task"] for table in tables] == GRID["tasks"]

    run_benchmark(tmp_path, grid, "--methods", "bc", "--no-training", "--policies", str(tmp_path / "policies"))
    small = tmp_path / "policies/bc/seed3.npz"
    policy, config = load_policy(small)
    model, _ = load_run(tmp_path / "runs/bc/seed3/model.zip")
    observations = np.random.default_rng(0).normal(size=(5, *model.observation_space.shape)).astype(np.float32)
    actions, of_small = (player.predict(observations, deterministic=True)[0] for player in (model, policy))
    np.testing.assert_allclose(of_small, actions, atol=0.05)  # the weights of the small file are rounded
    assert config["env"] == GRID["env"] and small.stat().st_size < 100_000


def test_a_run_of_all_tasks_keeps_no_evaluation_of_an_earlier_one(data, tmp_path):
    for rate, tasks in ((1e-4, GRID["tasks"]), (1e-2, ["door-open"])):
        methods = {"bc": {"algo": "bc", "config": "bc", "changes": {"learning_rate": rate}}}
        run_benchmark(tmp_path, write_grid(tmp_path, data, methods=methods, tasks=tasks))
    rows = run_benchmark(tmp_path, write_grid(tmp_path, data, methods=methods), "--no-training")
    assert rows == []  # because of the other task, it has to be trained again


def test_parts_of_a_grid_share_the_run_of_all_tasks(data, tmp_path):
    grid = write_grid(tmp_path, data)
    run_benchmark(tmp_path, grid, "--methods", "bc", "--tasks", "door-open")
    model = tmp_path / "runs/bc/seed3/model.zip"
    before = model.stat().st_mtime_ns
    for task in ("drawer-open", "door-open"):
        rows = run_benchmark(tmp_path, grid, "--methods", "bc", "--tasks", task)
    assert len(rows) == 4 and model.stat().st_mtime_ns == before


def test_two_processes_write_one_table(data, tmp_path):
    """Each writes its own cells, although both begin before the other has written any."""
    grid = load_grid(write_grid(tmp_path, data, methods={"bc": GRID["methods"]["bc"]}, seeds=[3, 4]))
    cells = [plan(grid, tmp_path / "runs", grid.cells(seeds=[seed])) for seed in grid.seeds]
    writers = [table_writer(tmp_path / "table.csv", grid, part) for part in cells]
    for part, write in zip(cells, writers, strict=True):
        record_failure(next(iter(part.values())), "broke")
        write()
    assert [row["seed"] for row in read_results(tmp_path / "table.csv").rows] == ["3"] * 4 + ["4"] * 4


def test_a_process_that_dies_again_and_again_is_a_failure(data, tmp_path, monkeypatch):
    monkeypatch.setattr(local, "_work", _die)
    rows = run_benchmark(tmp_path, write_grid(tmp_path, data), "--methods", "bc", "--tasks", "door-open", fails=True)
    assert len(rows) == 2 and all("its process died 3 times, with exit code 7" in row["config"] for row in rows)


def _die(run):
    os._exit(7)


def test_a_method_may_have_data_of_its_own(data, tmp_path):
    own = {"dataset": "images.h5", "examples": "images_{task}.h5"}
    methods = {name: {"algo": "ceborl", "config": "ceborl", "changes": changes} for name, changes in (("a", {}), ("b", own))}
    cells = plan(load_grid(write_grid(tmp_path, data, methods=methods)), tmp_path / "runs")
    for name, expected in (("a", data), ("b", own)):
        training = cells[name, "door-open", 3].training
        assert training.dataset == expected["dataset"]
        assert training.examples == expected["examples"].replace("{task}", "door-open")


def test_the_report_plays_the_final_policies(data, tmp_path, monkeypatch):
    pytest.importorskip("rliable")
    from sb3_offline.report import aggregates

    monkeypatch.setattr(aggregates, "REPETITIONS", 10)
    options = ["--methods", "ceborl", "bc", "--tasks", "door-open"]
    run_benchmark(tmp_path, write_grid(tmp_path, data, n_timesteps=4), *options)
    cli.main(["report", str(tmp_path / "table.csv"), "-o", str(tmp_path / "report"), "--runs", str(tmp_path / "runs")])
    text = (tmp_path / "report/report.md").read_text()
    for name in ("table_door-open.jpg", "table_values.png"):
        with Image.open(tmp_path / "report" / name) as image:
            assert image.width > 200 and name in text
    results = read_results(tmp_path / "table.csv")
    assert [*results.entries["bc", "door-open"].by("step")] == [3, 4]
    assert [*with_early_checkpoints(results, tmp_path / "table.csv").entries["bc", "door-open"].by("step")] == [1, 2, 3, 4]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_timesteps": 41}, "multiple of 4"),
        ({"stepz": 1}, "stepz: unknown"),
        ({"tasks": "door-open"}, "tasks: is 'door-open'; give a list"),
        ({"methods": {"x": {"algo": "bc"}}}, "methods: x: config: missing"),
        ({"save_freq": 0}, "save_freq: is 0"),
        ({"tasks": [1, 2]}, r"tasks: is \[1, 2\]; give a list of names"),
        ({"seeds": [0.5]}, r"seeds: is \[0.5\]; give a list of whole numbers"),
        ({"methods": {"a b": GRID["methods"]["bc"], "a-b": GRID["methods"]["bc"]}}, "share a folder"),
        ({"examples": None}, "ceborl learns from success examples"),
        ({"examples": "nowhere/{task}.h5"}, "no such success examples"),
    ],
)
def test_a_wrong_grid_is_refused_before_anything_runs(data, tmp_path, changes, message):
    with pytest.raises(SystemExit, match=message):
        run_benchmark(tmp_path, write_grid(tmp_path, data, **changes))
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    "name",
    [
        "table1_states",
        "table1_pixels",
        "tuning_states",
        "tuning_pixels",
        "ceborl_states",
        "ceborl_pixels",
        "second_table_states",
    ],
)
def test_shipped_grids_can_be_planned(name, tmp_path):
    grid = load_grid(name)
    assert len(plan(grid, tmp_path)) == len(grid.methods) * len(grid.tasks) * len(grid.seeds)
    assert (grid.checkpoints, grid.episodes) == (5, 10)
