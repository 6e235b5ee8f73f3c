"""Tables and figures of the results."""

import csv
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parent.parent / "benchmarks"))

import ablation
import tables

from sb3_offline.benchmark.grid import merged
from sb3_offline.benchmark.table import write_table


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
    assert merged(config, change) == {"beta": 0.1, "policy_kwargs": expected}


def test_every_row_of_the_ablation_has_a_bar(tmp_path):
    with (tmp_path / "table.csv").open("w") as file:
        file.write("group,variant,task,seed,step,episodes,successes\n")
        file.writelines(f"{g},{v},{t},0,6,10,4\n" for g, v, t in [("default", "default", "a"), ("odds", "x", "b")])
    ablation.plot(tmp_path / "table.csv", tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 5000


def test_the_ablation_names_group_and_variant(tmp_path):
    row = dict.fromkeys(("task", "seed", "step", "episodes", "successes", "config", "commit", "versions"), "1")
    write_table(tmp_path / "table.csv", [{"method": "beta = 1", **row}])
    ablation.write_variants(tmp_path / "table.csv", tmp_path / "ablation.csv")
    with (tmp_path / "ablation.csv").open() as file:
        assert list(csv.DictReader(file)) == [{"group": "penalty (a)", "variant": "beta = 1", **row}]
