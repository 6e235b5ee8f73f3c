"""Train a grid and write its table."""

import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from sb3_offline.benchmark.grid import Cell, Grid, GridRun
from sb3_offline.benchmark.table import failure_of, table_writer
from sb3_offline.data.reader import open_datasets
from sb3_offline.experiment.policy_file import save_policy
from sb3_offline.experiment.run import MODEL_FILE
from sb3_offline.experiment.training import load_run

DAMAGED_MODEL = "model.damaged.zip"


def run_grid(
    grid: Grid, cells: Mapping[Cell, GridRun], output: Path, train: Callable[[list[GridRun]], Iterable[GridRun]] | None
) -> Iterator[str]:
    """
    Train the unfinished runs, and write the table at the start and after every run. All evaluations, for learning curves, go
    to
    :func:`~sb3_offline.benchmark.table.curves_file`.

    :param grid: the grid
    :param cells: cells to fill, from :func:`~sb3_offline.benchmark.grid.plan`; rows of other cells of the grid stay in the
        table
    :param output: the CSV file
    :param train: trains runs and yields each when it ends; ``None`` only writes the table of the finished runs
    :return: messages for the user, as they arise
    """
    began = time.monotonic()
    write = table_writer(output, grid, cells)
    trainings = list({run.folder: run for run in cells.values()}.values())
    if train:
        yield from _set_damaged_models_aside(trainings)
    unfinished = [run for run in trainings if not run.is_finished()] if train else []
    _check_files(unfinished)
    write()
    yield f"{len(trainings)} runs fill {len(cells)} cells; {len(unfinished)} are to be trained"
    for number, run in enumerate(train(unfinished) if train else [], start=1):
        write()
        minutes = (time.monotonic() - began) / 60
        yield f"[{number}/{len(unfinished)}, {minutes:.0f} min] {run.label}: {_outcome(run)}"


def _set_damaged_models_aside(runs: Sequence[GridRun]) -> Iterator[str]:
    """Give damaged models of finished runs another name, so that these runs, and no others, are trained again."""
    for run in runs:
        model = run.folder / MODEL_FILE
        if not model.is_file():
            continue
        try:
            with zipfile.ZipFile(model) as archive:
                damaged = archive.testzip()
        except (zipfile.BadZipFile, OSError, EOFError, ValueError, NotImplementedError) as error:
            damaged = " ".join(str(error).split())
        if damaged is not None:
            model.replace(model.with_name(DAMAGED_MODEL))
            yield f"{model}: is damaged ({damaged}), so this run starts again; the file is kept as {DAMAGED_MODEL}"


def export_policies(cells: Mapping[Cell, GridRun], runs: Path, folder: Path) -> int:
    """
    Save the final policy of each finished run in a small file, named like the folder of the run.

    :param cells: from :func:`~sb3_offline.benchmark.grid.plan`
    :param runs: folder of the runs
    :param folder: folder for the policies
    :return: number of policies
    """
    finished = {run.folder for run in cells.values() if run.is_finished()}
    for source in sorted(finished):
        save_policy(folder / f"{source.relative_to(runs)}.npz", *load_run(source / MODEL_FILE, trust=True))
    return len(finished)


def _check_files(runs: list[GridRun]) -> None:
    """Raise an error for a missing file before any run starts, since it would make every run fail."""
    for dataset in {str(run.training.dataset): run.training.dataset for run in runs}.values():
        open_datasets(dataset)
    for examples in sorted({run.training.examples for run in runs if run.training.examples}):
        if not Path(examples).exists():
            raise RuntimeError(f"{examples}: there are no such success examples; make them, or correct `examples:`")


def _outcome(run: GridRun) -> str:
    failure = failure_of(run)
    if failure:
        return f"failed: {failure}"
    rows = [row for table in run.tables() for row in table.counted_rows(run.grid.n_timesteps)]
    solved, episodes = (sum(int(row[name]) for row in rows) for name in ("successes", "episodes"))
    return f"{solved} of {episodes} episodes solved"
