"""The command ``sb3-offline label``."""

import argparse
import os
from pathlib import Path

import numpy as np

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import check_outputs
from sb3_offline.data_tools.inspecting.joined_datasets import JoinedDatasets
from sb3_offline.data_tools.inspecting.label_page import write_label_page
from sb3_offline.labelling import ClassifierSettings, check_labels, label_episodes, save_labels, write_labelled_copy
from sb3_offline.labelling.episodes import solved_episodes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    defaults = ClassifierSettings()
    parser.add_argument("dataset", nargs="+", help="dataset files or patterns; several are labelled together")
    parser.add_argument("--examples", required=True, help="success examples: folder of images, .npz, .npy or HDF5 file")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="LABELS", help="file of labels to write, for configs and select_detected"
    )
    parser.add_argument(
        "--copy", type=Path, metavar="DATASET", help="also write a copy of the data with these labels as success"
    )
    parser.add_argument("--html", type=Path, metavar="PAGE", help="also write a page of the frames at the threshold")
    parser.add_argument(
        "--check",
        nargs="?",
        const="success",
        metavar="ARRAY[:COLUMN]",
        help="compare with labels of the data afterwards: success (default), or another array such as extras/task_success:2",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the classifier (default: 0)")
    parser.add_argument(
        "--steps", type=int, help="gradient steps of each network (default: 300 from vectors, 200 from images)"
    )
    parser.add_argument("--models", type=int, default=defaults.n_models, help=f"networks (default: {defaults.n_models})")
    parser.add_argument("--device", default="auto", help="device to compute on (default: a GPU, if there is one)")
    parser.add_argument("--overwrite", action="store_true", help="replace the output files")
    parser.add_argument("--trust", action="store_true", help="open files that may run any code, such as pickles of others")


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    outputs = [path for path in (args.output, args.copy, args.html) if path]
    for path in (args.output, args.copy):
        if path and os.path.exists(path.expanduser()) and not args.overwrite:
            raise DatasetError(path, "file", "exists already", "Give --overwrite to replace it")
    data = JoinedDatasets(args.dataset, trust=args.trust)
    check_outputs(outputs, [*(part.path for part in data.parts), args.examples])
    if args.copy and len(data.parts) > 1:
        raise RuntimeError("--copy copies one file; label several with -o, and give the file to configs as `labels`")
    solved = solved_episodes(data.parts, args.check) if args.check else None  # before the work, since it may be misspelled
    settings = ClassifierSettings(n_models=args.models, gradient_steps=args.steps)
    labels = label_episodes(data.parts, args.examples, settings=settings, seed=args.seed, device=args.device)
    check = None if solved is None else check_labels(labels, np.asarray(solved))
    for warning in labels.warnings:
        print(f"Warning: {warning}.")
    precision, successes = labels.estimated_precision, labels.estimated_successes
    print(f"{labels.detected.sum():,} of {len(labels.lengths):,} episodes look like the examples.")
    print(
        f"Estimated without labels: {precision.value:.1%} of them are successes ({precision.low:.1%} to {precision.high:.1%}),"
    )
    print(f"and the data hold {successes.value:,.0f} successes ({successes.low:,.0f} to {successes.high:,.0f}).")
    if check is not None:
        print(
            f"By {args.check}: {check.successes:,} successes, AUC {check.auc:.4f}, precision {check.precision:.3f}, ", end=""
        )
        print(f"recall {check.recall:.3f}.")
    origin = {"data": [str(part.path) for part in data.parts], "examples": str(args.examples)}
    if args.output:
        save_labels(args.output, labels, origin)
        print(f"Labels: {args.output}")
    if args.copy:
        write_labelled_copy(args.copy, data.parts[0], labels, origin, overwrite=args.overwrite)
        print(f"Labelled copy: {args.copy}")
    if args.html:
        write_label_page(args.html, data, labels, args.examples, check)
        print(f"Page: {args.html}")
