"""The command ``sb3-offline collect``."""

import argparse
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    parser.add_argument("output", help="HDF5 file to write")
    parser.add_argument("--episodes-per-task", type=int, default=300, help="number of attempts at each task (default: 300)")
    parser.add_argument("--table", default="paper", help="name of the environment's table: paper (default) or second")
    parser.add_argument("--tasks", nargs="+", help="tasks to attempt (default: all of the table)")
    parser.add_argument(
        "--obs-type", choices=("state", "pixels", "both"), default="state", help="observations (default: state)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the collection (default: 0)")
    parser.add_argument(
        "--workers", type=int, default=2, help="number of processes, which does not change the file (default: 2)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    from sb3_offline.data_tools.collecting.scripted import collect_scripted  # needs the extra metaworld

    if args.episodes_per_task < 1:
        sys.exit(f"sb3-offline: --episodes-per-task is {args.episodes_per_task}; give a number of at least 1")
    if Path(args.output).exists() and not args.overwrite:
        sys.exit(f"sb3-offline: {args.output} exists already; name another file, or add --overwrite")
    shares = collect_scripted(
        args.output,
        episodes_per_task=args.episodes_per_task,
        tasks=args.tasks,
        obs_type=args.obs_type,
        seed=args.seed,
        n_workers=args.workers,
        mode="w" if args.overwrite else "x",
        table=args.table,
    )
    for task, share in shares.items():
        print(f"{task:<12} {share:6.1%} of the episodes solved")
