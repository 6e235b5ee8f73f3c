"""What the documents say is what the files say."""

import subprocess
import sys
from pathlib import Path

import pytest

from sb3_offline.report.results import comparison_table, read_results

ROOT = Path(__file__).resolve().parent.parent


def test_tables_in_documents_are_those_of_the_results():
    subprocess.run([sys.executable, "benchmarks/tables.py", "--check"], cwd=ROOT, check=True)


@pytest.mark.parametrize("name", ["table1_states", "table1_pixels"])
def test_readme_and_report_show_the_table(name):
    file = ROOT / f"results/{name}.csv"
    table = comparison_table(read_results(file))
    assert f"<!-- {file.relative_to(ROOT)} -->\n\n{table}\n\n<!-- end -->" in (ROOT / "README.md").read_text()
    report = (ROOT / "docs/results/report.md").read_text()
    assert table in report and (ROOT / "docs/results/notes.md").read_text().strip() in report
