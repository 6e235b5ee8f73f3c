"""The command ``sb3-offline``: parse, call the library, print."""

import argparse
import functools
import os
import sys
from collections.abc import Callable
from pathlib import Path

from sb3_offline.envs import ENV_ID, lacks_task


def main(argv: list[str] | None = None) -> None:
    """:param argv: the command line, default ``sys.argv``"""
    argv = sys.argv[1:] if argv is None else argv
    try:
        arguments = _parser(argv[:1]).parse_args(argv)
        arguments.run(arguments)
    except (RuntimeError, ValueError, OSError) as error:
        sys.exit(f"sb3-offline: {error}")
    except ModuleNotFoundError as error:
        extra = _EXTRAS.get((error.name or "").split(".")[0])
        if extra is None:
            raise
        sys.exit(f'sb3-offline: {error}; install it with: pip install "sb3-offline[{extra}]"')
    except Exception as error:
        if type(error).__module__ != "gymnasium.error":
            raise
        sys.exit(f"sb3-offline: {error}")


_EXTRAS = {
    "metaworld": "metaworld",
    "mujoco": "metaworld",
    "matplotlib": "plots",
    "minari": "minari",
    "pyarrow": "imitation",
    "ray": "ray",
    "rliable": "report",
}


def _parser(chosen: list[str]) -> argparse.ArgumentParser:
    """:param chosen: the command whose options are wanted: those of others import what may not be installed"""
    parser = argparse.ArgumentParser(prog="sb3-offline", description="Offline reinforcement learning for Stable-Baselines3")
    commands = parser.add_subparsers(required=True, metavar="command")

    def add(name: str, text: str, setup: Callable[[argparse.ArgumentParser], Callable]) -> None:
        command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        if name in chosen:
            command.set_defaults(run=setup(command))

    add("collect", "roll out the scripted policies, with noise and aborted attempts", _collect)
    add("collect-sac", "roll out trained SAC agents: data like the paper's", _tool("collect_sac"))
    add("train-sac", "train the agents that collect-sac rolls out", _tool("train_sac"))
    add("export-sac", "choose and measure checkpoints of train-sac for collect-sac", _tool("export_sac"))
    add("examples", "take success examples out of a labelled dataset", _tool("extract_examples"))
    add("inspect", "say what is in a dataset and what looks wrong", _tool("inspect_dataset"))
    add("render", "draw the frames of a dataset anew, of another size or camera", _tool("render_dataset"))
    add("convert", "compress a dataset, lay it out raw, or take over another library's", _tool("convert_dataset"))
    add("train", "train one policy", _train)
    add("evaluate", "play a trained policy", _evaluate)
    add("benchmark", "train and evaluate a grid of methods, tasks and seeds", _benchmark)
    add("report", "make tables and figures of a benchmark's results", _report)
    add("demo", "collect, train, evaluate and report, all by itself", _demo)
    return parser


def _tool(name: str) -> Callable[[argparse.ArgumentParser], Callable]:
    """A program of the data tools, which brings its own options."""

    def setup(parser: argparse.ArgumentParser) -> Callable:
        import importlib

        module = importlib.import_module(f"sb3_offline.data_tools.{name}")
        module.add_arguments(parser)
        return module.run

    return setup


def _collect(parser: argparse.ArgumentParser) -> Callable:
    parser.add_argument("output", help="HDF5 file to write")
    parser.add_argument("--episodes-per-task", type=int, default=300)
    parser.add_argument("--table", default="paper", help='of the environment: "paper" (default) or "second"')
    parser.add_argument("--tasks", nargs="+", help="default: all of the table")
    parser.add_argument("--obs-type", choices=("state", "pixels"), default="state")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2, help="processes; the file is the same for any number")
    parser.add_argument("--overwrite", action="store_true")

    def run(args: argparse.Namespace) -> None:
        from sb3_offline.data_tools.collect_scripted import collect_scripted

        if Path(args.output).exists() and not args.overwrite:
            sys.exit(f"sb3-offline: {args.output} exists already; name another file, or add --overwrite")
        shares = collect_scripted(
            args.output,
            episodes_per_task=args.episodes_per_task,
            tasks=args.tasks,
            obs_type=args.obs_type,
            seed=args.seed,
            n_workers=args.workers,
            mode="w" if args.overwrite else "x",
            table=args.table,
        )
        for task, share in shares.items():
            print(f"{task:<12} {share:6.1%} of the episodes solved")

    return run


def _train(parser: argparse.ArgumentParser) -> Callable:
    parser.add_argument("--algo", default="ceborl", help="bc, ceborl, cql, dcql, iql, oril, rce or td3_bc")
    parser.add_argument("--env", default=ENV_ID)
    parser.add_argument("--task", help="of the multimodal environment, e.g. door-open")
    parser.add_argument("--config", help="a shipped config's name or a YAML file (default: the algorithm's)")
    parser.add_argument("--dataset", nargs="+", help="dataset files or patterns (default: the config's)")
    parser.add_argument("--examples", help="folder of pictures, .npz or HDF5 file (default: the config's)")
    parser.add_argument("-n", "--n-timesteps", type=int, help="gradient steps (default: the config's)")
    parser.add_argument("--hyperparams", nargs="*", default=[], metavar="KEY:VALUE", help="overwrite the config's")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--eval-freq", type=int, default=0, help="gradient steps between evaluations (default: none)")
    parser.add_argument("--eval-episodes", type=int, default=20)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the model and its tables")

    def run(args: argparse.Namespace) -> None:
        from sb3_offline.experiment.config import load_config, parse_overrides
        from sb3_offline.experiment.training import find_algorithm, train

        find_algorithm(args.algo)  # before its config is looked for

        config = {**load_config(args.config or args.algo, args.env), **parse_overrides(args.hyperparams)}
        if args.n_timesteps is not None:
            config["n_timesteps"] = args.n_timesteps
        train(
            args.algo,
            args.env,
            config,
            args.output,
            dataset=args.dataset[0] if args.dataset and len(args.dataset) == 1 else args.dataset,
            examples=args.examples,
            env_kwargs={"task": args.task} if args.task else {},
            seed=args.seed,
            eval_freq=args.eval_freq,
            n_eval_episodes=args.eval_episodes,
            verbose=1,
        )
        print(f"Saved {args.output / 'model.zip'}")

    return run


def _evaluate(parser: argparse.ArgumentParser) -> Callable:
    parser.add_argument("model", type=Path, help="model.zip of a run, or a policy of benchmark --policies")
    parser.add_argument("--task", help="of the multimodal environment (default: the run's, where it was trained for one task)")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=100_000, help="of the episodes")
    parser.add_argument("--gif", type=Path, help="record some of them")

    def run(args: argparse.Namespace) -> None:
        from sb3_offline.experiment.evaluation import evaluate_success

        if args.gif and args.gif.suffix.lower() != ".gif":
            sys.exit(f"sb3-offline: --gif {args.gif}: is no name of a GIF; end it in .gif")
        if args.model.suffix == ".npz":
            from sb3_offline.experiment.policy_file import load_policy as load
        else:
            from sb3_offline.experiment.training import load_run as load  # type: ignore[assignment]
        model, run_config = load(args.model)
        if args.task:
            run_config["env_kwargs"]["task"] = args.task
        if lacks_task(run_config["env"], run_config["env_kwargs"]):
            sys.exit(f"sb3-offline: {args.model}: was trained for no task in particular; say which one it is to play: --task")
        result = evaluate_success(model, run_config["env"], run_config["env_kwargs"], args.episodes, args.seed)
        low, high = result.interval
        print(f"{sum(result.successes)} of {args.episodes} episodes solved: {result.success_rate:.2f} [{low:.2f}, {high:.2f}]")
        if args.gif:
            from sb3_offline.experiment.recording import record_gif

            record_gif(model, run_config["env"], run_config["env_kwargs"], args.gif, seed=args.seed)
            print(f"Saved {args.gif}")

    return run


def _benchmark(parser: argparse.ArgumentParser) -> Callable:
    parser.add_argument("grid", help="a YAML file, or a shipped grid's name, e.g. table1_states")
    parser.add_argument(
        "--runs", type=Path, required=True, help="folder of the runs; what is finished or saved there is taken up"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        help="CSV file, written anew after every run; of cells that were not asked for, rows stay",
    )
    parser.add_argument("--workers", type=int, help="runs at once, one thread each (default: as many as there are cores)")
    parser.add_argument("--ray-address", help='train on a Ray cluster that shares the file system ("auto", "local")')
    parser.add_argument("--methods", nargs="+", help="some of the grid's only")
    parser.add_argument("--tasks", nargs="+", help="likewise")
    parser.add_argument("--seeds", nargs="+", type=int, help="likewise")
    parser.add_argument("--no-training", action="store_true", help="write the table of what is finished")
    parser.add_argument("--policies", type=Path, help="folder for the final policies as small files")

    def run(args: argparse.Namespace) -> None:
        from sb3_offline.benchmark.grid import load_grid, plan
        from sb3_offline.benchmark.runner import export_policies, run_grid

        train: Callable | None = None
        if args.ray_address and not args.no_training:
            from sb3_offline.benchmark.on_ray import train_on_ray

            train = functools.partial(train_on_ray, address=args.ray_address)
        elif not args.no_training:
            from sb3_offline.benchmark.local import train_locally

            train = functools.partial(train_locally, n_workers=args.workers or os.cpu_count() or 1)
        grid = load_grid(args.grid)
        cells = plan(grid, args.runs, grid.cells(args.methods, args.tasks, args.seeds))
        for line in run_grid(grid, cells, args.output, train):
            print(line, flush=True)
        if args.policies:
            print(f"{export_policies(cells, args.runs, args.policies)} policies -> {args.policies}")

    return run


def _report(parser: argparse.ArgumentParser) -> Callable:
    parser.add_argument("tables", nargs="+", type=Path, help="CSV files of sb3-offline benchmark")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for report.md and its figures")
    parser.add_argument("--runs", nargs="+", type=Path, default=[], help="folder of the runs of each: adds film strips")
    parser.add_argument("--reference", default="ceborl", help="the method that others are compared with (default: ceborl)")
    parser.add_argument("--notes", type=Path, help="a Markdown file to begin with")

    def run(args: argparse.Namespace) -> None:
        from sb3_offline.report.report import write_report

        for line in write_report(args.tables, args.output, args.runs, args.reference, args.notes):
            print(line, flush=True)

    return run


def _demo(parser: argparse.ArgumentParser) -> Callable:
    parser.add_argument("--task", default="drawer-open")
    parser.add_argument("--obs-type", choices=("state", "pixels"), default="state")
    parser.add_argument("--episodes-per-task", type=int, default=300, help="in the dataset, of five tasks (default: 300)")
    parser.add_argument("-n", "--n-timesteps", type=int, help="gradient steps of each method (default: the configs')")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, default=Path("demo"))

    def run(args: argparse.Namespace) -> None:
        from sb3_offline.demo.pipeline import DemoSettings, run_demo

        settings = DemoSettings(
            task=args.task,
            obs_type=args.obs_type,
            episodes_per_task=args.episodes_per_task,
            n_timesteps=args.n_timesteps,
            seed=args.seed,
        )
        print(run_demo(args.output, settings))
        print(f"Report: {args.output / 'report.md'}")

    return run


if __name__ == "__main__":
    main()
