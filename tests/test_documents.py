"""The documents say what the files and the registry say."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from sb3_offline import ALGOS
from sb3_offline.report.results import comparison_table, read_results

ROOT = Path(__file__).resolve().parent.parent

#: Headings that the page of each algorithm has, in this order
SECTIONS = [
    "## Notes",
    "## Can I use?",
    "## Example",
    "## Results",
    "### How to replicate the results?",
    "## Comments",
    "## Parameters",
]

#: Of all tracked files together
MAX_BYTES = 12_000_000


def test_tables_in_documents_are_those_of_the_results():
    subprocess.run([sys.executable, "benchmarks/tables.py", "--check"], cwd=ROOT, check=True)


@pytest.mark.parametrize("name", ["table1_states", "table1_pixels"])
def test_readme_and_report_show_the_table(name):
    file = ROOT / f"results/{name}.csv"
    table = comparison_table(read_results(file))
    assert f"<!-- {file.relative_to(ROOT)} -->\n\n{table}\n\n<!-- end -->" in (ROOT / "README.md").read_text()
    report = (ROOT / "docs/results/report.md").read_text()
    assert table in report and (ROOT / "docs/results/notes.md").read_text().strip() in report


@pytest.mark.parametrize("name", ALGOS)
def test_each_algorithm_is_documented(name):
    page = f"docs/algorithms/{name}.md"
    headings = [line for line in (ROOT / page).read_text().splitlines() if line in SECTIONS]
    assert headings == SECTIONS
    assert f"[`{ALGOS[name].__name__}`]({page})" in (ROOT / "README.md").read_text()


def test_first_page_lists_the_registry():
    table = runpy.run_path(str(ROOT / "docs/conf.py"))["algorithm_table"]()
    assert len(table.splitlines()) == 2 + len(ALGOS)
    assert all(f"](algorithms/{name}.md) |" in table for name in ALGOS)
    assert "Eq |" not in table  # a sentence does not end at an abbreviation
    assert "```{include} _generated/algorithms.md\n```" in (ROOT / "docs/index.md").read_text()


def test_repository_stays_small():
    try:
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    files = [ROOT / name for name in listed.decode().split("\0") if name]
    assert sum(file.stat().st_size for file in files if file.is_file()) < MAX_BYTES


def test_promises_name_tests_that_exist():
    words = re.findall(r"`(test_\w+\.py|test_\w+(?:\.\.\.)?)`", (ROOT / "docs/promises.md").read_text())
    source, n_tests = "", 0
    for word in words:
        if word.endswith(".py"):
            source = (ROOT / "tests" / word).read_text()
        else:
            n_tests += 1
            assert f"def {word.removesuffix('...')}" in source, word
    assert n_tests > 20
