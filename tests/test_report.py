"""A report agrees with its CSV file."""

import csv

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("rliable")

from sb3_offline import cli
from sb3_offline.benchmark.table import FIELDS
from sb3_offline.experiment.evaluation import success_interval
from sb3_offline.report import aggregates
from sb3_offline.report.results import Results, comparison_table, paper_rates, read_results

TASKS = ["dial-turn", "door-open", "drawer-open", "lever-pull", "plate-slide"]
RATES = {"ceborl": [8, 10, 9, 5, 10], "rce": [2, 3, 0, 1, 0], "mine": [0, 0, 0, 7, 9]}


@pytest.fixture
def table(tmp_path):
    """Two seeds and two checkpoints. The second seed of RCE solves dial-turn once more, and one of its runs broke off."""
    with (tmp_path / "table1_x.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(FIELDS)
        for seed in (0, 1):
            for place, task in enumerate(TASKS):
                for method, solved in RATES.items():
                    more = int(method == "rce" and task == "dial-turn") * seed
                    config = "rce (failed: it)" if (method, task, seed) == ("rce", "door-open", 1) else method
                    for step in (80, 100):
                        writer.writerow([method, task, seed, step, 10, solved[place] + more, config, "abc", "torch 2"])
    return tmp_path / "table1_x.csv"


def test_the_table_holds_ours_beside_the_papers(table):
    lines = comparison_table(read_results(table)).splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| ceborl", "| ceborl, paper", "| rce", "| rce, paper", "| mine"]
    low, high = success_interval(32, 40)
    assert lines[2].startswith(f"| ceborl | 2 x 20 | 0.80 ({low:.2f} to {high:.2f}) | 1.00 ")
    assert lines[2].endswith(" | **0.84** |")
    assert lines[3] == "| ceborl, paper | 3 x 50 | 0.75 | 0.93 | 0.00 | 0.56 | 0.93 | 0.63 |"
    assert " 0.25 (" in lines[4] and ", crashed |" in lines[4]
    part = Results("part", [row for row in read_results(table).rows if row["task"] != TASKS[0]])
    assert comparison_table(part).splitlines()[3].endswith("| 0.93 |  |")  # the mean of the paper is over other tasks


def test_the_papers_numbers_agree_with_its_means():
    rates = paper_rates()
    for method in ("ceborl", "rce", "oril", "bc", "dcql"):
        assert abs(np.mean([rates[method, task] for task in TASKS]) - rates[method, "all"]) < 0.0051


def test_aggregates_are_those_of_rliables_paper(table, monkeypatch):
    monkeypatch.setattr(aggregates, "REPETITIONS", 50)
    results = read_results(table)
    means = aggregates.interquartile_means(results)
    middle = np.sort(np.repeat([0.8, 1.0, 0.9, 0.5, 1.0], 2))[2:8]  # two of ten runs are cut off on each side
    assert means["ceborl"].value == pytest.approx(middle.mean())
    better = aggregates.improvement_probabilities(results, "ceborl")
    assert better["rce"].value == 1.0 and better["mine"].value == pytest.approx(0.8)
    assert means["rce"].interval[0] < means["rce"].value < means["rce"].interval[1]
    assert str(aggregates.interquartile_means(results)["rce"]) == str(means["rce"])  # each time the same


def test_one_command_makes_the_report(table, tmp_path, monkeypatch):
    monkeypatch.setattr(aggregates, "REPETITIONS", 50)
    (tmp_path / "notes.md").write_text("The budget was ten trials.")
    cli.main(["report", str(table), "-o", str(tmp_path / "report"), "--notes", str(tmp_path / "notes.md")])
    text = (tmp_path / "report/report.md").read_text()
    for part in ("ten trials", "ceborl 0.84 (paper 0.63); mine 0.32; rce", "- rce, door-open, seed 1: it", "80, 100"):
        assert part in text
    for name in ("table1_x.png", "table1_x_curves.png"):
        with Image.open(tmp_path / "report" / name) as image:
            assert image.width > 500


def test_tables_of_one_name_are_refused(table, tmp_path):
    """Their figures would have one name."""
    other = tmp_path / "other" / table.name
    other.parent.mkdir()
    other.write_bytes(table.read_bytes())
    with pytest.raises(SystemExit, match="rename those of the same name"):
        cli.main(["report", str(table), str(other), "-o", str(tmp_path / "report")])


def test_an_unknown_reference_is_refused(table, tmp_path):
    with pytest.raises(SystemExit, match="no method 'cebrol'"):
        cli.main(["report", str(table), "-o", str(tmp_path / "report"), "--reference", "cebrol"])


@pytest.mark.parametrize(("content", "message"), [(None, "no such file"), ("method,task\nx,y\n", "seed, step, ")])
def test_what_is_no_table_is_refused(tmp_path, content, message):
    if content:
        (tmp_path / "x.csv").write_text(content)
    with pytest.raises(SystemExit, match=message):
        cli.main(["report", str(tmp_path / "x.csv"), "-o", str(tmp_path / "report")])
