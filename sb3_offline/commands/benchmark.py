"""The command ``sb3-offline benchmark``."""

import argparse
import functools
import os
import sys
from collections.abc import Callable
from pathlib import Path

from sb3_offline.benchmark.grid import load_grid, plan
from sb3_offline.benchmark.local import train_locally
from sb3_offline.benchmark.runner import export_policies, run_grid
from sb3_offline.benchmark.table import failure_of
from sb3_offline.data.errors import printable
from sb3_offline.data.files import check_outputs


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    parser.add_argument("grid", help="a YAML file, or the name of a shipped grid, e.g. table1_states")
    parser.add_argument(
        "--runs",
        type=Path,
        required=True,
        help="folder of the runs; finished runs in it are used, and unfinished ones continued",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        help="CSV file, which is written after every run; rows of cells that are not selected stay",
    )
    parser.add_argument("--workers", type=int, help="number of runs at a time, one thread each (default: number of cores)")
    parser.add_argument("--ray-address", help='train on a Ray cluster that shares the file system ("auto", "local")')
    parser.add_argument("--methods", nargs="+", help="select methods of the grid (default: all)")
    parser.add_argument("--tasks", nargs="+", help="select tasks of the grid (default: all)")
    parser.add_argument("--seeds", nargs="+", type=int, help="select seeds of the grid (default: all)")
    parser.add_argument("--no-training", action="store_true", help="only write the table of the finished runs")
    parser.add_argument("--policies", type=Path, help="folder for the final policies as small files")


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    check_outputs([args.output, args.output.with_name(f"{args.output.stem}_curves.csv")], [args.grid])
    train: Callable | None = None
    if args.ray_address and not args.no_training:
        from sb3_offline.benchmark.on_ray import train_on_ray  # needs the extra ray

        train = functools.partial(train_on_ray, address=args.ray_address)
    elif not args.no_training:
        train = functools.partial(train_locally, n_workers=args.workers or os.cpu_count() or 1)
    grid = load_grid(args.grid)
    cells = plan(grid, args.runs, grid.cells(args.methods, args.tasks, args.seeds))
    for line in run_grid(grid, cells, args.output, train):
        print(printable(line), flush=True)
    if args.policies:
        print(f"{export_policies(cells, args.runs, args.policies)} policies -> {args.policies}")
    failed = {run.label for run in cells.values() if failure_of(run)}
    if failed and train is not None:
        sys.exit(f"sb3-offline: {len(failed)} runs failed; {args.output} says why, in its column config")
