"""Read the CSV file of a grid, and set its success rates beside those of the paper."""

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
class Entry:
    """
    One entry of the comparison table: all checkpoints of all seeds of one method on one task.

    :param rows: its rows of the CSV file
    """

    rows: list[dict[str, str]]

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return sum(int(row["episodes"]) for row in self.rows)

    @property
    def successes(self) -> int:
        """Number of solved episodes."""
        return sum(int(row["successes"]) for row in self.rows)

    @property
    def counts(self) -> str:
        """Number of seeds and average number of episodes of each: "3 x 50"."""
        n_seeds = len(self.by("seed"))
        return f"{n_seeds} x {self.episodes // n_seeds}"

    @property
    def rate(self) -> float:
        """Share of solved episodes."""
        return self.successes / self.episodes

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the rate, as if all episodes were independent."""
        return success_interval(self.successes, self.episodes)

    @property
    def failed(self) -> bool:
        """True if one of its runs broke off."""
        return any(FAILED in row["config"] for row in self.rows)

    def by(self, name: str) -> dict[int, "Entry"]:
        """
        :param name: ``"seed"`` or ``"step"``
        :return: the part with each value, in ascending order
        """
        values = sorted({int(row[name]) for row in self.rows})
        return {value: Entry([row for row in self.rows if int(row[name]) == value]) for value in values}


@dataclass(frozen=True)
class Results:
    """
    The results of a grid.

    :param name: name of the CSV file, without its suffix
    :param rows: rows of the CSV file
    """

    name: str
    rows: list[dict[str, str]]

    @cached_property
    def methods(self) -> list[str]:
        """The methods, in the order of the file."""
        return list(dict.fromkeys(row["method"] for row in self.rows))

    @cached_property
    def tasks(self) -> list[str]:
        """The tasks in alphabetical order, which is that of the paper."""
        return sorted({row["task"] for row in self.rows})

    @cached_property
    def entries(self) -> dict[tuple[str, str], Entry]:
        """The entries by method and task. Those without a run are missing."""
        entries: dict[tuple[str, str], list[dict[str, str]]] = {}
        for row in self.rows:
            entries.setdefault((row["method"], row["task"]), []).append(row)
        return {key: Entry(rows) for key, rows in entries.items()}

    @cached_property
    def means(self) -> dict[str, float]:
        """Mean rate over the tasks, for the methods that have run on all of them; the highest first."""
        whole = [method for method in self.methods if all((method, task) in self.entries for task in self.tasks)]
        means = {method: sum(self.entries[method, task].rate for task in self.tasks) / len(self.tasks) for method in whole}
        return dict(sorted(means.items(), key=lambda item: -item[1]))

    @cached_property
    def paper(self) -> dict[tuple[str, str], float]:
        """The paper's rates by method and task, and for "all" if its tasks are those of this grid."""
        rates = paper_rates()
        if {task for _, task in rates} - {"all"} == {*self.tasks}:
            return rates
        return {(method, task): rate for (method, task), rate in rates.items() if task in self.tasks}

    def seeds(self, method: str) -> list[int]:
        """
        :param method: name of a method
        :return: the seeds of its runs that exist for all tasks
        """
        of_tasks = [
            set(self.entries[method, task].by("seed")) if (method, task) in self.entries else set() for task in self.tasks
        ]
        return sorted(set.intersection(*of_tasks))


def read_results(path: Path) -> Results:
    """
    :param path: a CSV file of ``sb3-offline benchmark``
    :return: its results; raises ``RuntimeError`` if it is not such a file
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
    :param results: results of a grid
    :param table: the CSV file that they were read from
    :return: the results with further rows, for the evaluations before the steps that count, if the file of all evaluations
        exists
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
    """:return: the success rates of the paper's Table 1 by method and task, and for "all" tasks"""
    with (resources.files("sb3_offline.report") / "paper_table1.csv").open() as file:
        return {(row["method"], row["task"]): float(row["success_rate"]) for row in csv.DictReader(file)}


def comparison_table(results: Results) -> str:
    """
    :param results: results of a grid
    :return: a Markdown table: for each method our success rates with their 95 % intervals, and below them those of the paper
    """
    paper = results.paper
    lines = [f"| method | seeds x episodes | {' | '.join(results.tasks)} | mean |", "|---" * (len(results.tasks) + 3) + "|"]
    for method in results.methods:
        own = [results.entries.get((method, task)) for task in results.tasks]
        counts = sorted({entry.counts for entry in own if entry})
        mean = f"**{results.means[method]:.2f}**" if method in results.means else ""
        line = [method, " or ".join(counts), *(entry_text(entry) if entry else "" for entry in own), mean]
        lines.append(f"| {' | '.join(line)} |")
        if any(name == method for name, _ in paper):
            theirs = [f"{paper[method, task]:.2f}" if (method, task) in paper else "" for task in [*results.tasks, "all"]]
            lines.append(f"| {method}, paper | 3 x 50 | {' | '.join(theirs)} |")
    return "\n".join(lines)


def entry_text(entry: Entry) -> str:
    """
    :param entry: an entry
    :return: its rate and interval, such as "0.46 (0.33 to 0.60)"
    """
    low, high = entry.interval
    return f"{entry.rate:.2f} ({low:.2f} to {high:.2f})" + ", crashed" * entry.failed
