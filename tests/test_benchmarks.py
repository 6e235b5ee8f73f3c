"""The machinery of the tables: what crashes stays as a failure, and what is finished is not trained again."""

import argparse
import csv
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parent.parent / "benchmarks"))

import ablation
import cells
import tables

from sb3_offline.experiment.training import is_finished


@pytest.fixture
def args(tmp_path, monkeypatch):
    for name, value in {"EPISODES_A_CHECKPOINT": 1, "N_CHECKPOINTS": 2, "HELD_OUT_EPISODES": 8, "N_EXAMPLES": 2}.items():
        monkeypatch.setattr(cells, name, value)
    parser = argparse.ArgumentParser()
    cells.add_arguments(parser, str(tmp_path / "runs"), "table.csv", ["door-open"], [0])
    paths = ["--data", str(tmp_path / "data.h5"), "--examples-dir", str(tmp_path / "examples")]
    return parser.parse_args([*paths, "--episodes-per-task", "2", "--steps", "8", "--workers", "1"])


def test_a_crash_is_a_row_and_stops_nothing(args, tmp_path):
    cells.prepare_data(args)
    right = {"policy": "MlpPolicy", "batch_size": 4, "env_kwargs": {"obs_type": "state"}}
    configs = {"wrong": {**right, "batch_size": "many"}, "right": right}
    table = [
        ({"method": name, "seed": 3, "config": name}, cells.cell_run(args, "bc", config, name, "door-open", 3))
        for name, config in configs.items()
    ]
    cells.train_cells([run for _, run in table], n_workers=1)
    cells.write_rows(tmp_path / "table.csv", table)
    with (tmp_path / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["method"], row["step"], row["episodes"]) for row in rows] == [
        (name, step, "1") for name in configs for step in ("6", "8")
    ]
    assert all("(failed: " in row["config"] and row["successes"] == "0" for row in rows[:2])
    assert rows[2]["config"] == "right" and rows[2]["commit"]
    run = table[1][1]
    assert run["eval_seeds"] == [104_000, 104_001]
    assert is_finished(run["output"], run)
    other = {**run, "config": {**run["config"], "batch_size": 5}}
    assert not is_finished(run["output"], other)
    before = (run["output"] / "model.zip").stat().st_mtime_ns
    cells.train_cells([run], n_workers=1)
    assert (run["output"] / "model.zip").stat().st_mtime_ns == before


def test_rates_are_means_over_seeds_with_their_range():
    cases = [("x", "a", 0, 10, ""), ("x", "a", 1, 5, ""), ("x", "b", 0, 5, ""), ("y", "a", 0, 0, "bc (failed: it)")]
    names = ("method", "task", "seed", "successes", "config")
    rows = [{**dict(zip(names, map(str, case), strict=True)), "episodes": "10", "commit": "c"} for case in cases]
    assert tables.rate_table(rows).splitlines()[2:] == [
        "| x | 0.75 (0.50 to 1.00) | 0.50 | 0.62 |",
        "| y | 0.00, crashed |  |  |",
    ]


def test_changes_join_what_the_default_has():
    config = {"beta": 0.1, "policy_kwargs": {"n_critics": 2, "features_extractor_kwargs": {"std_min": 0.1}}}
    change = {"policy_kwargs": {"features_extractor_kwargs": {"std_min": 1.0}}}
    expected = {"n_critics": 2, "features_extractor_kwargs": {"std_min": 1.0}}
    assert ablation.changed(config, change) == {"beta": 0.1, "policy_kwargs": expected}


def test_every_row_of_the_ablation_has_a_bar(tmp_path):
    with (tmp_path / "table.csv").open("w") as file:
        file.write("group,variant,task,seed,step,episodes,successes\n")
        file.writelines(f"{g},{v},{t},0,6,10,4\n" for g, v, t in [("default", "default", "a"), ("odds", "x", "b")])
    ablation.plot(tmp_path / "table.csv", tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 5000
