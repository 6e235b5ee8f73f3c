"""
Write the tables of the README and the docs from the CSV files in results/.

    python benchmarks/tables.py [--check]

A table stands between `<!-- results/NAME.csv -->` and `<!-- end -->`; nothing between the two is typed by hand.
"""

import csv
import re
import sys
from pathlib import Path

from sb3_offline.demo.pipeline import result_table

ROOT = Path(__file__).resolve().parent.parent
BLOCK = re.compile(r"(<!-- (results/\S+\.csv) -->\n).*?(<!-- end -->)", re.DOTALL)


def table(path: Path) -> str:
    """:return: the CSV file as a Markdown table"""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return checkpoint_table(rows) if "variant" in rows[0] else result_table(rows)


def checkpoint_table(rows: list[dict[str, str]]) -> str:
    """A row a variant, a column a checkpoint."""
    steps = sorted({int(row["step"]) for row in rows})
    lines = ["| variant | change | " + " | ".join(f"step {step}" for step in steps) + " |", "|---" * (2 + len(steps)) + "|"]
    for variant in dict.fromkeys(row["variant"] for row in rows):
        own = {int(row["step"]): row for row in rows if row["variant"] == variant}
        change = next(iter(own.values()))["change"]
        cells = (f"{own[step]['successes']} of {own[step]['episodes']}" if step in own else "" for step in steps)
        lines.append(f"| {variant} | {f'`{change}`' if change else ''} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def filled(text: str) -> str:
    """:return: the text with all of its tables made anew"""
    return BLOCK.sub(lambda match: f"{match[1]}\n{table(ROOT / match[2])}\n\n{match[3]}", text)


def documents() -> list[Path]:
    """:return: the files that may hold tables"""
    return [ROOT / "README.md", *(path for path in (ROOT / "docs").rglob("*.md") if "_build" not in path.parts)]


def main() -> None:
    stale = [path for path in documents() if filled(path.read_text()) != path.read_text()]
    if "--check" in sys.argv and stale:
        sys.exit(f"tables differ from results/ in {', '.join(str(path.relative_to(ROOT)) for path in stale)}")
    for path in stale:
        path.write_text(filled(path.read_text()))


if __name__ == "__main__":
    main()
