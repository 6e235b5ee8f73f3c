"""The command ``sb3-offline convert``."""

import argparse
import sys
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

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
    for name, bound in (("low", "lower"), ("high", "upper")):
        parser.add_argument(
            f"--action-{name}",
            type=float,
            nargs="+",
            metavar="BOUND",
            help=f"{bound} bounds of the actions' entries, where the source declares none",
        )
    parser.add_argument("--overwrite", action="store_true", help="replace the destination if it is a file")
    parser.add_argument("--trust", action="store_true", help="open files that may run any code, such as pickles of others")


def _action_space(args: argparse.Namespace) -> spaces.Box:
    low, high = args.action_low or [], args.action_high or []
    if len(low) != len(high) or not np.less(low, high).all():
        problem = f"--action-low has {len(low)} numbers, and --action-high {len(high)}"
        sys.exit(f"sb3-offline: {problem}; give both, a lower and a higher number for each entry of an action")
    return spaces.Box(np.array(low, np.float32), np.array(high, np.float32))


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    declared: dict[str, Any] = {}
    if args.env:
        env = gym.make(args.env)
        declared = {"observation_space": env.observation_space, "action_space": env.action_space}
        declared["max_episode_steps"] = env.spec.max_episode_steps if env.spec else None
        env.close()
    if args.action_low or args.action_high:
        declared["action_space"] = _action_space(args)
    dataset = OfflineDataset(args.source, **declared, trust=args.trust)
    dataset.header.env_id = dataset.header.env_id or args.env or ""
    convert(dataset, args.destination, args.storage, overwrite=args.overwrite)
