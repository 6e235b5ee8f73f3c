"""A grid's CSV file as numbers, beside those of the paper."""

import csv
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path

from sb3_offline.benchmark.table import curves_file
from sb3_offline.experiment.evaluation import success_interval

COUNTS = ("episodes", "successes")
COLUMNS = ("method", "task", "seed", "step", *COUNTS, "config", "commit")
FAILED = "(failed: "


@dataclass(frozen=True)
class Cell:
    """
    Of one method and one task, all checkpoints of all seeds.

    :param rows: of the CSV file
    """

    rows: list[dict[str, str]]

    @property
    def episodes(self) -> int:
        return sum(int(row["episodes"]) for row in self.rows)

    @property
    def successes(self) -> int:
        return sum(int(row["successes"]) for row in self.rows)

    @property
    def counts(self) -> str:
        """Seeds and, on average, episodes of each: "3 x 50"."""
        n_seeds = len(self.by("seed"))
        return f"{n_seeds} x {self.episodes // n_seeds}"

    @property
    def rate(self) -> float:
        return self.successes / self.episodes

    @property
    def interval(self) -> tuple[float, float]:
        """95 % (Wilson's), as if all episodes were independent."""
        return success_interval(self.successes, self.episodes)

    @property
    def failed(self) -> bool:
        """Whether a run of it broke off."""
        return any(FAILED in row["config"] for row in self.rows)

    def by(self, name: str) -> dict[int, "Cell"]:
        """
        :param name: ``"seed"`` or ``"step"``
        :return: the part of each value, in order
        """
        values = sorted({int(row[name]) for row in self.rows})
        return {value: Cell([row for row in self.rows if int(row[name]) == value]) for value in values}


@dataclass(frozen=True)
class Results:
    """
    :param name: of the CSV file
    :param rows: of it
    """

    name: str
    rows: list[dict[str, str]]

    @cached_property
    def methods(self) -> list[str]:
        """In the order of the file."""
        return list(dict.fromkeys(row["method"] for row in self.rows))

    @cached_property
    def tasks(self) -> list[str]:
        """In the order of the alphabet, which is the paper's."""
        return sorted({row["task"] for row in self.rows})

    @cached_property
    def cells(self) -> dict[tuple[str, str], Cell]:
        """By method and task; those that have not been run are missing."""
        cells: dict[tuple[str, str], list[dict[str, str]]] = {}
        for row in self.rows:
            cells.setdefault((row["method"], row["task"]), []).append(row)
        return {key: Cell(rows) for key, rows in cells.items()}

    @cached_property
    def means(self) -> dict[str, float]:
        """Over the tasks, of the methods that have been run on all of them; the highest first."""
        whole = [method for method in self.methods if all((method, task) in self.cells for task in self.tasks)]
        means = {method: sum(self.cells[method, task].rate for task in self.tasks) / len(self.tasks) for method in whole}
        return dict(sorted(means.items(), key=lambda item: -item[1]))

    @cached_property
    def paper(self) -> dict[tuple[str, str], float]:
        """The paper's rates by method and task, and of "all" where these are the tasks here."""
        rates = paper_rates()
        if {task for _, task in rates} - {"all"} == {*self.tasks}:
            return rates
        return {(method, task): rate for (method, task), rate in rates.items() if task in self.tasks}

    def seeds(self, method: str) -> list[int]:
        """:return: of a method, the seeds that have been run on all tasks"""
        of_tasks = [set(self.cells[method, task].by("seed")) if (method, task) in self.cells else set() for task in self.tasks]
        return sorted(set.intersection(*of_tasks))


def read_results(path: Path) -> Results:
    """
    :param path: of a CSV file of ``sb3-offline benchmark``
    :return: what it holds
    """
    if not path.is_file():
        raise RuntimeError(f"{path}: there is no such file; make it with: sb3-offline benchmark GRID.yml -o {path} ...")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    missing = [name for name in COLUMNS if name not in (rows[0] if rows else {})]
    if missing:
        raise RuntimeError(
            f"{path}: {', '.join(missing)}: missing, or there is no row yet; a file of sb3-offline benchmark has "
            f"{', '.join(COLUMNS)}"
        )
    return Results(path.stem, rows)


def with_early_checkpoints(results: Results, table: Path) -> Results:
    """
    :param results: ours
    :param table: the CSV file that they are of
    :return: with a row for each evaluation of a step before those that count, where the file of all evaluations is there
    """
    path = curves_file(table)
    if not path.is_file():
        return results
    first = min(int(row["step"]) for row in results.rows)
    counted = {(row["method"], row["task"], row["seed"]) for row in results.rows}
    with path.open(newline="") as file:
        early = [{**row, "config": ""} for row in csv.DictReader(file) if int(row["step"]) < first]
    early = [row for row in early if (row["method"], row["task"], row["seed"]) in counted]
    return Results(results.name, [*results.rows, *early])


def paper_rates() -> dict[tuple[str, str], float]:
    """:return: the paper's Table 1: the success rate of each method and task, and of "all" tasks"""
    with (resources.files("sb3_offline.report") / "paper_table1.csv").open() as file:
        return {(row["method"], row["task"]): float(row["success_rate"]) for row in csv.DictReader(file)}


def comparison_table(results: Results) -> str:
    """
    :param results: ours
    :return: Markdown: of each method our success rates with their 95 % intervals, and the paper's below them
    """
    paper = results.paper
    lines = [f"| method | seeds x episodes | {' | '.join(results.tasks)} | mean |", "|---" * (len(results.tasks) + 3) + "|"]
    for method in results.methods:
        own = [results.cells.get((method, task)) for task in results.tasks]
        counts = sorted({cell.counts for cell in own if cell})
        mean = f"**{results.means[method]:.2f}**" if method in results.means else ""
        line = [method, " or ".join(counts), *(cell_text(cell) if cell else "" for cell in own), mean]
        lines.append(f"| {' | '.join(line)} |")
        if any(name == method for name, _ in paper):
            theirs = [f"{paper[method, task]:.2f}" if (method, task) in paper else "" for task in [*results.tasks, "all"]]
            lines.append(f"| {method}, paper | 3 x 50 | {' | '.join(theirs)} |")
    return "\n".join(lines)


def cell_text(cell: Cell) -> str:
    """:return: "0.46 (0.33 to 0.60)" """
    low, high = cell.interval
    return f"{cell.rate:.2f} ({low:.2f} to {high:.2f})" + ", crashed" * cell.failed
