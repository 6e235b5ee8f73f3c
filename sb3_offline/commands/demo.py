"""The command ``sb3-offline demo``."""

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    parser.add_argument("--task", default="drawer-open", help="the task to learn (default: drawer-open)")
    parser.add_argument("--obs-type", choices=("state", "pixels"), default="state", help="observations (default: state)")
    parser.add_argument(
        "--episodes-per-task", type=int, default=300, help="number of attempts at each of the five tasks (default: 300)"
    )
    parser.add_argument("-n", "--n-timesteps", type=int, help="gradient steps of each method (default: those of the configs)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the data and the runs (default: 0)")
    parser.add_argument("-o", "--output", type=Path, default=Path("demo"), help="folder for the results (default: demo)")


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    from sb3_offline.demo.pipeline import DemoSettings, run_demo  # needs the extras metaworld and plots

    settings = DemoSettings(
        task=args.task,
        obs_type=args.obs_type,
        episodes_per_task=args.episodes_per_task,
        n_timesteps=args.n_timesteps,
        seed=args.seed,
    )
    print(run_demo(args.output, settings))
    print(f"Report: {args.output / 'report.md'}")
