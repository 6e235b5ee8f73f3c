"""The command ``sb3-offline convert``."""

import argparse
from typing import Any

import gymnasium as gym

from sb3_offline.data.convert import convert
from sb3_offline.data.reader import OfflineDataset


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    formats = "file, folder or minari:ID of another library (LeRobot, robomimic, D4RL, ...)"
    parser.add_argument("source", help=f"dataset file of either storage, or {formats}")
    parser.add_argument("destination", help="file to write, or minari:ID")
    parser.add_argument(
        "--storage",
        choices=("contiguous", "compressed"),
        default="contiguous",
        help="storage of the file (default: contiguous)",
    )
    parser.add_argument(
        "--env", help="id of the environment, for the spaces and the time limit that the source does not declare"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the destination if it is a file")
    parser.add_argument("--trust", action="store_true", help="open files that may run any code, such as pickles of others")


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    declared: dict[str, Any] = {}
    if args.env:
        env = gym.make(args.env)
        declared = {"observation_space": env.observation_space, "action_space": env.action_space}
        declared["max_episode_steps"] = env.spec.max_episode_steps if env.spec else None
        env.close()
    dataset = OfflineDataset(args.source, **declared, trust=args.trust)
    dataset.header.env_id = dataset.header.env_id or args.env or ""
    convert(dataset, args.destination, args.storage, overwrite=args.overwrite)
