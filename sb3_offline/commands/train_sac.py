"""The command ``sb3-offline train-sac``."""

import argparse
from pathlib import Path

from sb3_offline.data_tools.sac.training import SETTINGS, train_tasks
from sb3_offline.envs.multimodal_metaworld import TASKS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    parser.add_argument(
        "output", type=Path, help="folder, with a folder for each task: curve.csv, policies/ and the state to continue from"
    )
    parser.add_argument(
        "--tasks", nargs="+", choices=TASKS, default=list(TASKS), help="tasks to train for (default: all five)"
    )
    parser.add_argument(
        "-n", "--n-timesteps", type=int, default=200_000, help="number of decisions for each task, rounded up to whole slices"
    )
    parser.add_argument("--settings", choices=list(SETTINGS), default="n_step", help="arguments of SAC (default: n_step)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the runs (default: 0)")
    parser.add_argument(
        "--eval-freq", type=int, default=5_000, help="number of decisions in a slice: whole episodes of 50 (default: 5000)"
    )
    parser.add_argument("--eval-episodes", type=int, default=20, help="number of episodes after each slice (default: 20)")
    parser.add_argument(
        "--workers",
        type=int,
        default=1,
        help="number of processes of one thread, which does not change the result (default: 1)",
    )


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    curves = train_tasks(
        args.output,
        args.tasks,
        args.n_timesteps,
        settings=args.settings,
        seed=args.seed,
        eval_freq=args.eval_freq,
        n_eval_episodes=args.eval_episodes,
        n_workers=args.workers,
    )
    for task, curve in curves:
        best = max(curve, key=lambda row: int(row["successes"]))
        print(f"{task:<12} best after {best['step']} decisions: {best['successes']} of {best['episodes']} solved")
