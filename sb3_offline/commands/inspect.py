"""The command ``sb3-offline inspect``."""

import argparse
import json
from pathlib import Path

import gymnasium as gym

from sb3_offline.data.files import check_outputs
from sb3_offline.data_tools.inspecting.dataset_statistics import inspect_dataset
from sb3_offline.data_tools.inspecting.joined_datasets import JoinedDatasets
from sb3_offline.data_tools.inspecting.page import write_page
from sb3_offline.data_tools.inspecting.summary import format_summary


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    parser.add_argument("dataset", nargs="+", help="dataset files or patterns; several are inspected together")
    parser.add_argument("--html", type=Path, metavar="PAGE", help="also write a page for the browser, in one file")
    parser.add_argument("--examples", help="success examples to compare with the data: folder, .npz, .npy or HDF5 file")
    parser.add_argument("--env", help="id of an environment: warn where the data do not fit its spaces and time limit")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a text")
    parser.add_argument("--trust", action="store_true", help="open files that may run any code, such as pickles of others")


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    data = JoinedDatasets(args.dataset, trust=args.trust)
    if args.html:
        check_outputs([args.html], [*(part.path for part in data.parts), args.examples])
    env = gym.make(args.env) if args.env else None
    summary = inspect_dataset(data, args.examples, env)
    if env is not None:
        env.close()
    print(json.dumps(summary, indent=2) if args.json else format_summary(summary))
    if args.html:
        write_page(args.html, data, summary, args.examples)
        if not args.json:
            print(f"\nPage: {args.html}")
