"""From a grid to its table."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from sb3_offline.benchmark.grid import Cell, Grid, Run
from sb3_offline.benchmark.table import failure_of, table_writer
from sb3_offline.data.reader import open_datasets
from sb3_offline.experiment.policy_file import save_policy
from sb3_offline.experiment.training import load_run


def run_grid(
    grid: Grid, cells: Mapping[Cell, Run], output: Path, train: Callable[[list[Run]], Iterable[Run]] | None
) -> Iterator[str]:
    """
    Train what is not finished, and write the table at once and after every run; all evaluations, for learning curves, go to
    :func:`~sb3_offline.benchmark.table.curves_file`.

    :param grid: whose table it is
    :param cells: to fill, of :func:`~sb3_offline.benchmark.grid.plan`; rows in ``output`` of the grid's other cells stay
    :param output: CSV file
    :param train: trains runs and gives back each when it is over; ``None`` to write the table of what is finished
    :return: what to tell the user, when it happens
    """
    began = time.monotonic()
    write = table_writer(output, grid, cells)
    trainings = list({run.folder: run for run in cells.values()}.values())
    unfinished = [run for run in trainings if not run.is_finished()] if train else []
    _check_files(unfinished)
    write()
    yield f"{len(trainings)} runs fill {len(cells)} cells; {len(unfinished)} are to be trained"
    for number, run in enumerate(train(unfinished) if train else [], start=1):
        write()
        minutes = (time.monotonic() - began) / 60
        yield f"[{number}/{len(unfinished)}, {minutes:.0f} min] {run.label}: {_outcome(run)}"


def export_policies(cells: Mapping[Cell, Run], runs: Path, folder: Path) -> int:
    """
    :param cells: of :func:`~sb3_offline.benchmark.grid.plan`
    :param runs: folder of the runs
    :param folder: gets the final policy of each finished run as a file named like the run's folder
    :return: how many there are
    """
    finished = {run.folder for run in cells.values() if run.is_finished()}
    for source in sorted(finished):
        save_policy(folder / f"{source.relative_to(runs)}.npz", *load_run(source / "model.zip"))
    return len(finished)


def _check_files(runs: list[Run]) -> None:
    """A path that is wrong for all of them would make a failure of each."""
    for dataset in {str(run.arguments["dataset"]): run.arguments["dataset"] for run in runs}.values():
        open_datasets(dataset)
    for examples in sorted({run.arguments["examples"] for run in runs if run.arguments["examples"]}):
        if not Path(examples).exists():
            raise RuntimeError(f"{examples}: there are no such success examples; make them, or correct `examples:`")


def _outcome(run: Run) -> str:
    failure = failure_of(run)
    if failure:
        return f"failed: {failure}"
    rows = [row for table in run.tables() for row in table.counted_rows(run.grid.n_timesteps)]
    solved, episodes = (sum(int(row[name]) for row in rows) for name in ("successes", "episodes"))
    return f"{solved} of {episodes} episodes solved"
