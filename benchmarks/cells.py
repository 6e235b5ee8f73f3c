"""
What the tables of runs share: their data, their protocol, and training that goes on after a crash or a stop.

The protocol, fixed before any run: a cell counts by its last five checkpoints, at 60, 70, 80, 90 and 100 % of its gradient
steps, with ten episodes each, which are other ones at each checkpoint and for each seed, but the same ones for all cells of a
seed. No checkpoint is chosen. Where a cell crashes, the checkpoints that it never reached count as ten failures each, and its
column `config` says what went wrong.
"""

import argparse
import csv
import subprocess
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from sb3_offline.data.examples import save_examples
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data_tools.collect_scripted import TASKS, collect_scripted
from sb3_offline.data_tools.extract_examples import extract_examples
from sb3_offline.experiment.evaluation import EVALUATION_SEED
from sb3_offline.experiment.parallel import train_in_parallel
from sb3_offline.experiment.training import is_finished

ENV_ID = "MultimodalMetaworld-v0"
ROOT = Path(__file__).resolve().parent.parent
N_CHECKPOINTS, EPISODES_A_CHECKPOINT = 5, 10
N_EXAMPLES, HELD_OUT_SEED, HELD_OUT_EPISODES = 200, 1000, 120


def add_arguments(parser: argparse.ArgumentParser, runs: str, output: str, tasks: list[str], seeds: list[int]) -> None:
    """
    :param parser: gets the options that all tables have
    :param runs: default folder of the runs
    :param output: default CSV file in ``results``
    :param tasks: default
    :param seeds: default
    """
    parser.add_argument("--data", type=Path, default=Path("data/scripted1500.h5"), help="collected where it is missing")
    parser.add_argument("--episodes-per-task", type=int, default=1500, help="to collect, where --data is missing")
    parser.add_argument("--examples-dir", type=Path, default=Path("data/examples"), help="likewise")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=tasks)
    parser.add_argument("--seeds", nargs="+", type=int, default=seeds)
    parser.add_argument("--steps", type=int, help="gradient steps (default: each config's)")
    parser.add_argument("--runs", type=Path, default=Path(runs))
    parser.add_argument("--output", type=Path, default=ROOT / "results" / output)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--no-training", action="store_true", help="write the table of the cells that are finished")


def prepare_data(args: argparse.Namespace) -> None:
    """Collect the unlabelled data, and examples from episodes apart from them, where there are none."""
    held_out = args.examples_dir / "held_out.h5"
    missing = [task for task in TASKS if not examples_file(args, task).exists()]
    for path, n_episodes, seed in ((args.data, args.episodes_per_task, 0), (held_out, HELD_OUT_EPISODES, HELD_OUT_SEED)):
        if not path.exists() and (path == args.data or missing):
            path.parent.mkdir(parents=True, exist_ok=True)
            unfinished = path.with_suffix(".unfinished.h5")
            collect_scripted(unfinished, episodes_per_task=n_episodes, seed=seed, n_workers=args.workers, mode="w")
            unfinished.rename(path)
    for task in missing:
        examples, provenance = extract_examples(held_out, N_EXAMPLES, source=task, held_out=True)
        save_examples(examples_file(args, task), examples, OfflineDataset(held_out).observation_space, provenance)


def examples_file(args: argparse.Namespace, task: str) -> Path:
    """:return: the success examples of a task"""
    return args.examples_dir / f"state-{task}.h5"


def cell_run(args: argparse.Namespace, algo: str, config: dict[str, Any], folder: str, task: str, seed: int) -> dict[str, Any]:
    """:return: arguments of ``train`` for one cell of a table"""
    n_timesteps = args.steps or config["n_timesteps"]
    spacing = n_timesteps // (2 * N_CHECKPOINTS)
    if spacing * 2 * N_CHECKPOINTS != n_timesteps:
        raise SystemExit(f"{n_timesteps} steps are no multiple of {2 * N_CHECKPOINTS}; give such a --steps")
    first_seed = EVALUATION_SEED + 1000 * (1 + seed)
    return {
        "algo": algo,
        "env_id": ENV_ID,
        "config": {**config, "n_timesteps": n_timesteps},
        "output": args.runs / folder / f"{task}-seed{seed}",
        "dataset": str(args.data),
        "examples": None if algo == "bc" else str(examples_file(args, task)),
        "env_kwargs": {"task": task},
        "seed": seed,
        "eval_freq": spacing,
        "n_eval_episodes": EPISODES_A_CHECKPOINT,
        "eval_start": spacing * (N_CHECKPOINTS + 1),
        "eval_seeds": list(range(first_seed, first_seed + N_CHECKPOINTS)),
    }


def train_cells(cells: list[dict[str, Any]], n_workers: int) -> None:
    """
    Train the cells that are not finished, and leave beside each run the commit it was made from, and what went wrong.

    :param cells: from :func:`cell_run`
    :param n_workers: processes
    """
    commit = current_commit()
    runs = {str(Path(*run["output"].parts[-2:])): run for run in cells if not is_finished(run["output"], run)}
    for run in runs.values():
        run["output"].mkdir(parents=True, exist_ok=True)
        (run["output"] / "commit").write_text(commit)
        for stale in ("failure", "evaluations.csv"):
            (run["output"] / stale).unlink(missing_ok=True)
    for label, error in train_in_parallel(runs, n_workers, keep_going=True).items():
        if isinstance(error, BrokenProcessPool):
            raise error  # a process was killed: that says nothing about this run
        (runs[label]["output"] / "failure").write_text(f"{type(error).__name__}: {error}")


def current_commit() -> str:
    """:return: the commit that the code is of, with a + where the code differs from it"""
    code = ["sb3_offline", "zoo_configs"]
    try:
        commit = subprocess.run(
            ["git", "rev-parse", "--short=9", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
        )
        changes = subprocess.run(["git", "status", "--porcelain", *code], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit.stdout.strip() + "+" * bool(changes.stdout.strip())


def write_rows(path: Path, cells: list[tuple[dict[str, Any], dict[str, Any]]]) -> None:
    """
    One row a checkpoint of every cell that is finished or has crashed.

    :param path: of the CSV file
    :param cells: columns that name the cell, and its run
    """
    rows, failed = [], {"episodes": str(EPISODES_A_CHECKPOINT), "successes": "0"}
    for names, run in cells:
        folder, failure = run["output"], run["output"] / "failure"
        if not is_finished(folder, run) and not failure.exists():
            continue
        table = folder / "evaluations.csv"
        found = {int(row["step"]): row for row in csv.DictReader(table.open())} if table.exists() else {}
        names = {**names, "config": names["config"] + (f" (failed: {failure.read_text()})" if failure.exists() else "")}
        for step in range(run["eval_start"], run["config"]["n_timesteps"] + 1, run["eval_freq"]):
            counts = {name: found.get(step, failed)[name] for name in failed}
            after = {"config": names["config"], "commit": (folder / "commit").read_text()}
            rows.append({**{key: value for key, value in names.items() if key != "config"}, "step": step, **counts, **after})
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows(rows)
