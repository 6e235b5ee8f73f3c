"""The command ``sb3-offline report``."""

import argparse
from pathlib import Path

from sb3_offline.data.files import check_outputs


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    parser.add_argument("tables", nargs="+", type=Path, help="CSV files of sb3-offline benchmark")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for report.md and its figures")
    parser.add_argument("--runs", nargs="+", type=Path, default=[], help="folder of the runs of each table, for film strips")
    parser.add_argument("--reference", default="ceborl", help="the method that others are compared with (default: ceborl)")
    parser.add_argument("--trust", action="store_true", help="open files that may run any code, such as pickles of others")
    parser.add_argument("--notes", type=Path, help="a Markdown file to begin the report with")


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    from sb3_offline.report.report import write_report  # needs the extra report

    check_outputs([args.output / "report.md"], [*args.tables, args.notes])
    for line in write_report(args.tables, args.output, args.runs, args.reference, args.notes, trust=args.trust):
        print(line, flush=True)
