"""The two CSV files of a grid: one with a row for each checkpoint that counts, one with a row for each evaluation."""

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sb3_offline.benchmark.grid import Cell, Grid, GridRun
from sb3_offline.benchmark.worker import FAILURE_FILE, PROVENANCE_FILE, read_texts
from sb3_offline.data.disk import is_full_disk, wait_for_room
from sb3_offline.data.files import locked_folder, replacing

FIELDS = ("method", "task", "seed", "step", "episodes", "successes", "config", "commit", "versions")
CURVE_FIELDS = ("method", "task", "seed", "step", "episodes", "successes")


def table_writer(output: Path, grid: Grid, cells: Mapping[Cell, GridRun]) -> Callable[[], None]:
    """
    :param output: the CSV file of the table
    :param grid: the grid
    :param cells: from :func:`~sb3_offline.benchmark.grid.plan`; rows of other cells of the grid stay in the files
    :return: a function that writes both CSV files in their current state
    """
    order = {cell: position for position, cell in enumerate(grid.cells())}
    files = [(output, FIELDS, table_rows), (curves_file(output), CURVE_FIELDS, curve_rows)]

    def write() -> None:
        output.parent.mkdir(parents=True, exist_ok=True)
        while True:
            try:
                return write_once()
            except OSError as error:
                if not is_full_disk(error, output.parent):
                    raise
                wait_for_room(output.parent)

    def write_once() -> None:
        with locked_folder(output.parent):  # another process may write other cells of the same table
            for path, fields, rows_of in files:
                rows = [*_rows_of(path, {*order} - {*cells}, fields), *rows_of(cells)]
                write_table(path, sorted(rows, key=lambda row: order[row["method"], row["task"], int(row["seed"])]), fields)

    return write


def table_rows(cells: Mapping[Cell, GridRun]) -> list[dict[str, Any]]:
    """
    :param cells: from :func:`~sb3_offline.benchmark.grid.plan`
    :return: rows with the columns :data:`FIELDS`, for the cells that are finished or have failed. In a failed cell, the
        checkpoints that it never reached count as failed episodes, and ``config`` holds the error.
    """
    rows = []
    for (method, task, seed), run in cells.items():
        failure = failure_of(run)
        if not (failure or run.is_finished()):
            continue
        grid = run.grid
        reached = run.table(task).rows(grid.n_timesteps) if run.training.is_recorded() else []
        found = {int(row["step"]): row for row in reached}
        provenance = {"commit": "", "versions": "", **read_texts(run.folder / PROVENANCE_FILE)}
        missing: dict[str, Any] = {"episodes": grid.episodes, "successes": 0}
        for step in grid.evaluation_steps():
            row = {"method": method, "task": task, "seed": seed, "step": step}
            row |= {name: int(found.get(step, missing)[name]) for name in missing}
            row["config"] = f"{grid.methods[method]}" + (f" (failed: {failure})" if failure else "")
            row |= {name: provenance[name] for name in ("commit", "versions")}
            rows.append(row)
    return rows


def curve_rows(cells: Mapping[Cell, GridRun]) -> list[dict[str, Any]]:
    """
    :param cells: from :func:`~sb3_offline.benchmark.grid.plan`
    :return: rows with the columns :data:`CURVE_FIELDS`, for the cells that are finished or have failed. They hold all
        evaluations, also those in the first half of a run, which do not count.
    """
    rows = []
    for (method, task, seed), run in cells.items():
        if run.is_finished() or (failure_of(run) and run.training.is_recorded()):
            named = {"method": method, "task": task, "seed": seed}
            found = run.table(task).rows(run.grid.n_timesteps)
            rows += [{**named, **{name: int(row[name]) for name in CURVE_FIELDS[3:]}} for row in found]
    return rows


def curves_file(table: Path) -> Path:
    """
    :param table: CSV file of a grid
    :return: the CSV file of all evaluations, in the same folder
    """
    return table.with_name(f"{table.stem}_curves.csv")


def _rows_of(path: Path, wanted: set[Cell], fields: Sequence[str]) -> list[dict[str, Any]]:
    """
    :param path: the CSV file, which an earlier call may have written
    :param wanted: cells
    :param fields: columns of the file
    :return: the rows of these cells
    """
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        if reader.fieldnames is None or [*reader.fieldnames] != [*fields]:
            raise RuntimeError(
                f"{path}: is not a table of sb3-offline benchmark and would be overwritten; name another --output"
            )
        try:
            return [row for row in reader if (row["method"], row["task"], int(row["seed"])) in wanted]
        except (ValueError, TypeError, csv.Error) as error:
            problem = f"{path}: line {reader.line_num} is damaged ({error})"
            raise RuntimeError(f"{problem}; remove the file: the runs of all cells write it again") from error


def failure_of(run: GridRun) -> str | None:
    """
    :param run: a run
    :return: the error that ended the run, or ``None``
    """
    failure = read_texts(run.folder / FAILURE_FILE)
    return str(failure.get("error")) if failure.get("run") == run.training.record() else None


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], fields: Sequence[str] = FIELDS) -> None:
    """
    :param path: the CSV file, which is replaced at once, so that readers always find a whole file
    :param rows: rows, such as those of :func:`table_rows`
    :param fields: columns of the file
    """
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, fields)
        writer.writeheader()
        writer.writerows(rows)
