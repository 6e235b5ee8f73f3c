"""The command ``sb3-offline examples``."""

import argparse
import os
import sys

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import save_examples
from sb3_offline.data.files import check_outputs
from sb3_offline.data.reader import open_datasets
from sb3_offline.data.spaces import subspace
from sb3_offline.data_tools.converting.extract_examples import extract_examples
from sb3_offline.data_tools.inspecting.example_check import few_episodes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    parser.add_argument("dataset", nargs="+", help="dataset files or patterns")
    parser.add_argument("-o", "--output", required=True, help="HDF5 file to write")
    parser.add_argument("-n", "--count", type=int, default=200, help="number of examples (default: 200)")
    parser.add_argument("--source", help="use only episodes of this source, e.g. door-open")
    parser.add_argument("--keys", nargs="+", help="write these keys of dict observations only, e.g. image (default: all)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw (default: 0)")
    parser.add_argument("--held-out", action="store_true", help="record that these episodes are not learned from")
    parser.add_argument("--overwrite", action="store_true", help="replace the output file")
    parser.add_argument("--trust", action="store_true", help="open files that may run any code, such as pickles of others")


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    if os.path.exists(args.output) and not args.overwrite:
        raise DatasetError(args.output, "file", "exists already", "Give --overwrite to replace it")
    datasets = open_datasets(args.dataset, trust=args.trust)
    check_outputs([args.output], [dataset.path for dataset in datasets])
    examples, provenance = extract_examples(
        datasets, args.count, source=args.source, seed=args.seed, held_out=args.held_out, keys=args.keys
    )
    space = datasets[0].observation_space
    space = subspace(space, args.keys) if args.keys else space
    save_examples(args.output, examples, space, provenance, overwrite=args.overwrite)
    n_episodes = sum(len(origin["episodes"]) for origin in provenance["datasets"])
    print(f"{args.count} examples from {n_episodes} episodes -> {args.output}")
    for warning in few_episodes(provenance):
        print(f"Warning: {warning.field}: {warning.problem}. {warning.remedy}.", file=sys.stderr)
