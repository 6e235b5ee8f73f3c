"""The command ``sb3-offline evaluate``."""

import argparse
import sys
from pathlib import Path

from sb3_offline.data.files import check_outputs
from sb3_offline.envs import lacks_task
from sb3_offline.experiment.evaluation import EVALUATION_SEED, evaluate_success
from sb3_offline.experiment.policy_file import load_policy
from sb3_offline.experiment.recording import record_gif
from sb3_offline.experiment.training import load_run


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    parser.add_argument("model", type=Path, help="model.zip of a run, or a policy file of benchmark --policies")
    parser.add_argument(
        "--task", help="task of the multimodal environment (default: the task that the policy was trained for)"
    )
    parser.add_argument("--episodes", type=int, default=50, help="number of episodes (default: 50)")
    parser.add_argument("--seed", type=int, default=EVALUATION_SEED, help=f"seed of the episodes (default: {EVALUATION_SEED})")
    parser.add_argument("--gif", type=Path, help="record the first episodes in this file")
    parser.add_argument("--trust", action="store_true", help="open files that may run any code, such as pickles of others")


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    if args.gif and args.gif.suffix.lower() != ".gif":
        sys.exit(f"sb3-offline: --gif {args.gif}: is not the name of a GIF; end it in .gif")
    if args.gif:
        check_outputs([args.gif], [args.model])
    model, config = load_policy(args.model) if args.model.suffix == ".npz" else load_run(args.model, trust=args.trust)
    if ":" in str(config["env"]) and not args.trust:
        module = str(config["env"]).rpartition(":")[0]
        remedy = "if you trust the origin of the policy, add --trust"
        sys.exit(f"sb3-offline: {args.model}: env: names {config['env']!r}, which runs the module {module}; {remedy}")
    if args.task:
        config["env_kwargs"]["task"] = args.task
    if lacks_task(config["env"], config["env_kwargs"]):
        sys.exit(f"sb3-offline: {args.model}: was trained for no task in particular; name the task to play: --task")
    result = evaluate_success(model, config["env"], config["env_kwargs"], args.episodes, args.seed)
    low, high = result.interval
    print(f"{sum(result.successes)} of {args.episodes} episodes solved: {result.success_rate:.2f} [{low:.2f}, {high:.2f}]")
    if args.gif:
        record_gif(model, config["env"], config["env_kwargs"], args.gif, seed=args.seed)
        print(f"Saved {args.gif}")
