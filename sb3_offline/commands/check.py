"""The command ``sb3-offline check``."""

import argparse
import sys

from sb3_offline.data.check import rescue
from sb3_offline.data.errors import DatasetError
from sb3_offline.experiment.check import check_all


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    parser.add_argument("files", nargs="+", metavar="DATA", help="datasets, examples, models, policies, folders of runs")
    parser.add_argument("--rescue", metavar="NEW_FILE", help="copy the intact episodes of a damaged dataset to a new file")
    parser.add_argument("--trust", action="store_true", help="open files that may run any code, such as pickles of others")


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    if args.rescue and len(args.files) > 1:
        raise DatasetError("", "--rescue", f"is given with {len(args.files)} files", "Give one damaged file")
    is_damaged = False
    for verdict in check_all(args.files, trust=args.trust):
        is_damaged |= bool(verdict.damages)
        for line in verdict.lines():
            print(line, flush=True)
    if args.rescue:
        n_intact, n_damaged = rescue(args.files[0], args.rescue)
        print(f"{n_intact} intact episodes -> {args.rescue}; {n_damaged} damaged ones are left behind")
    if is_damaged:
        sys.exit(1)
