"""The command ``sb3-offline train``."""

import argparse
import glob
import os
from pathlib import Path
from typing import Any

from sb3_offline import ALGOS
from sb3_offline.data.files import check_outputs
from sb3_offline.envs import ENV_ID
from sb3_offline.experiment.config import load_config, parse_overrides
from sb3_offline.experiment.run import CONFIG_FILE, MODEL_FILE, TrainingRun
from sb3_offline.experiment.training import RESUME_FILE, find_algorithm, train_run


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: parser of the command"""
    parser.add_argument("--algo", default="ceborl", help=f"one of {', '.join(ALGOS)} (default: ceborl)")
    parser.add_argument("--env", default=ENV_ID, help=f"id of the environment to evaluate in (default: {ENV_ID})")
    parser.add_argument("--task", help="task of the multimodal environment, e.g. door-open")
    parser.add_argument("--table", help="table of the multimodal environment: paper (default) or second")
    parser.add_argument("--config", help="name of a shipped config, or a YAML file (default: the algorithm's config)")
    parser.add_argument("--dataset", nargs="+", help="dataset files or patterns (default: those of the config)")
    parser.add_argument("--examples", help="folder of images, .npz, .npy or HDF5 file (default: the config's)")
    parser.add_argument("-n", "--n-timesteps", type=int, help="number of gradient steps (default: that of the config)")
    parser.add_argument("--hyperparams", nargs="*", default=[], metavar="KEY:VALUE", help="replace values of the config")
    parser.add_argument("--seed", type=int, default=0, help="seed of weights and batches (default: 0)")
    parser.add_argument(
        "--eval-freq", type=int, default=0, help="gradient steps between evaluations (default: no evaluations)"
    )
    parser.add_argument("--eval-episodes", type=int, default=20, help="number of episodes in each evaluation (default: 20)")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the model and its tables")


def run(args: argparse.Namespace) -> None:
    """:param args: values of the options"""
    find_algorithm(args.algo)  # before its config is looked for
    config = {**load_config(args.config or args.algo, args.env), **parse_overrides(args.hyperparams)}
    if args.n_timesteps is not None:
        config["n_timesteps"] = args.n_timesteps
    training = TrainingRun(
        args.algo,
        args.env,
        config,
        args.output,
        dataset=args.dataset[0] if args.dataset and len(args.dataset) == 1 else args.dataset,
        examples=args.examples,
        env_kwargs={name: value for name in ("task", "table") if (value := getattr(args, name)) is not None},
        seed=args.seed,
        eval_freq=args.eval_freq,
        n_eval_episodes=args.eval_episodes,
    )
    read = [
        args.config,
        *_examples(training.examples or config.get("examples")),
        *_files(training.dataset or config.get("dataset")),
    ]
    check_outputs([args.output / name for name in (MODEL_FILE, CONFIG_FILE, RESUME_FILE, "evaluations.csv")], read)
    train_run(training, verbose=1)
    print(f"Saved {args.output / MODEL_FILE}")


def _examples(examples: Any) -> list[Any]:
    """:return: the files of examples, of which a config may name one for each key"""
    return list(examples.values()) if isinstance(examples, dict) else [examples]


def _files(dataset: Any) -> list[str]:
    """:return: the files that paths and patterns of datasets stand for"""
    patterns = [dataset] if isinstance(dataset, str) else dataset if isinstance(dataset, list) else []
    return [file for pattern in patterns for file in [str(pattern), *glob.glob(os.path.expanduser(str(pattern)))]]
