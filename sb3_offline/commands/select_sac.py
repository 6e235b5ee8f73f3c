"""The command ``sb3-offline select-sac``."""

import argparse
from pathlib import Path

from sb3_offline.data_tools.sac.selection import select_checkpoints
from sb3_offline.envs.multimodal_metaworld import TASKS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    parser.add_argument("runs", nargs="+", type=Path, help="folders of train-sac")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for policies.json and the weights")
    parser.add_argument(
        "--tasks", nargs="+", choices=TASKS, default=list(TASKS), help="tasks to select for; checkpoints of other tasks stay"
    )
    parser.add_argument("--checkpoints", type=int, default=6, help="number of checkpoints of each run and task (default: 6)")
    parser.add_argument("--episodes", type=int, default=300, help="number of episodes to measure each with (default: 300)")
    parser.add_argument("--workers", type=int, default=2, help="number of processes (default: 2)")


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    for line in select_checkpoints(
        args.runs, args.output, args.tasks, args.checkpoints, n_episodes=args.episodes, n_workers=args.workers
    ):
        print(line, flush=True)
