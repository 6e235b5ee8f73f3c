"""The command ``sb3-offline collect-sac``."""

import argparse
import sys
import time
from pathlib import Path

from sb3_offline.data.files import check_outputs
from sb3_offline.data_tools import POLICIES
from sb3_offline.data_tools.collecting.card import write_card
from sb3_offline.data_tools.collecting.sac import (
    PAPER_SHARES,
    Collection,
    collect_shard,
    content_hash,
    success_shares,
    write_examples,
)
from sb3_offline.envs.multimodal_metaworld import TASKS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    parser.add_argument("output", type=Path, help="HDF5 file to write; an incomplete one is continued")
    parser.add_argument("--episodes-per-task", type=int, default=1500, help="number of attempts at each task (default: 1500)")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS), help="tasks to attempt (default: all five)")
    parser.add_argument(
        "--obs-type", choices=("state", "pixels", "both"), default="state", help="observations of the same episodes"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the collection (default: 0)")
    parser.add_argument("--policies", type=Path, default=POLICIES, help="folder of select-sac (default: the shipped one)")
    parser.add_argument(
        "--workers", type=int, default=2, help="number of processes, which does not change the file (default: 2)"
    )
    parser.add_argument("--shard", type=_shard, metavar="i/n", help="write only part i (0 to n-1) of n")
    parser.add_argument("--ray", metavar="ADDRESS", help='write --shards parts as tasks of a Ray cluster ("auto", "local")')
    parser.add_argument("--shards", type=int, default=8, help="number of parts with --ray (default: 8)")
    parser.add_argument("--examples", type=Path, help="folder for success examples of each task")
    parser.add_argument("--example-count", type=int, default=200, help="number of examples of each task (default: 200)")
    parser.add_argument(
        "--example-episodes", type=int, default=100, help="number of held-out attempts at each task to draw examples from"
    )
    parser.add_argument(
        "--examples-from", choices=("held-out", "data"), default="held-out", help="source of the examples (default: held-out)"
    )
    parser.add_argument("--card", type=Path, help="JSON file for a description of the dataset")


def _shard(text: str) -> tuple[int, int]:
    shard, _, n_shards = text.partition("/")
    if not (shard.isdecimal() and n_shards.isdecimal() and int(shard) < int(n_shards)):
        raise argparse.ArgumentTypeError(f"{text!r} is not i/n with 0 <= i < n")
    return int(shard), int(n_shards)


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    if args.card:
        check_outputs([args.card], [args.output, args.policies])
    check_outputs([args.output], [args.policies])
    if args.examples and args.output.resolve() in [
        (args.examples / f"{name}.h5").resolve() for name in ("held_out", *args.tasks)
    ]:
        sys.exit(f"sb3-offline: --examples {args.examples}: would write over {args.output}; name another folder")
    began = time.time()
    collection = Collection(
        args.episodes_per_task, tuple(args.tasks), args.obs_type, args.seed, policies=str(args.policies.resolve())
    )
    if args.ray:
        from sb3_offline.data_tools.collecting.on_ray import collect_on_ray  # needs the extra ray

        paths = collect_on_ray(args.output, collection, args.shards, address=args.ray)
    else:
        paths = [collect_shard(args.output, collection, *(args.shard or (0, 1)), n_workers=args.workers)]
    seconds = time.time() - began
    for task, share in success_shares(paths).items():
        print(f"{task:<12} {share:6.1%} of the episodes solved (in the paper {PAPER_SHARES[task]:.0%})")
    print(f"sha256 of actions and scene states: {content_hash(paths)}")
    if args.examples:
        held_out = args.example_episodes if args.examples_from == "held-out" else None
        write_examples(
            args.examples, paths, collection, args.example_count, held_out_episodes=held_out, n_workers=args.workers
        )
        print(f"{args.example_count} success examples of each task -> {args.examples}")
    if args.card:
        write_card(args.card, paths, seconds, " ".join(["sb3-offline", *sys.argv[1:]]))
