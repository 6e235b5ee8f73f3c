"""Convert a dataset between contiguous storage (for training) and compressed storage (for keeping and sending)."""

import argparse

from sb3_offline.data.convert import convert


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: gets the options of ``run``"""
    parser.add_argument("source", help="dataset file of either storage, or a D4RL-style file")
    parser.add_argument("destination", help="file to write")
    parser.add_argument("--storage", choices=("contiguous", "compressed"), required=True)
    parser.add_argument("--overwrite", action="store_true", help="replace the destination")


def run(args: argparse.Namespace) -> None:
    """:param args: what ``add_arguments`` asks for"""
    convert(args.source, args.destination, args.storage, overwrite=args.overwrite)
