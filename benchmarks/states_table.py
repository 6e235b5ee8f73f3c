"""
All methods on all tasks from state observations, with several seeds: the table of the docs.

    python benchmarks/states_table.py --data data/scripted1500.h5 --examples-dir data/examples

collects data and examples where they are missing, trains every cell of the table (finished ones are kept, so it can be stopped
and started again) and writes results/ceborl_states.csv, one row a checkpoint.

The protocol, fixed before any run: a cell counts by its last five checkpoints, at 60, 70, 80, 90 and 100 % of its gradient
steps, with ten episodes each, which are other ones at each checkpoint and for each seed, but the same ones for all methods. No
checkpoint is chosen. A cell that crashes has rows without episodes, which count as failures.
"""

import argparse
import csv
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from sb3_offline.data.examples import save_examples
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data_tools.collect_scripted import ENV_ID, TASKS, collect_scripted
from sb3_offline.data_tools.extract_examples import extract_examples
from sb3_offline.experiment.config import load_config
from sb3_offline.experiment.evaluation import EVALUATION_SEED
from sb3_offline.experiment.parallel import train_in_parallel
from sb3_offline.experiment.training import is_finished

ROOT = Path(__file__).resolve().parent.parent
FIELDS = ("method", "task", "seed", "step", "episodes", "successes", "config", "commit")
#: Row of the table: algorithm, shipped config, what is changed in it.
METHODS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "ceborl": ("ceborl", "ceborl", {}),
    "ceborl_paper": ("ceborl", "ceborl_paper", {}),
    "rce_1step": ("rce", "rce", {"n_steps": 1}),
    "rce_10step": ("rce", "rce", {"n_steps": 10}),
    "bc": ("bc", "bc", {}),
    "bc_filtered": ("bc", "bc_filtered", {}),
}
N_CHECKPOINTS, EPISODES_A_CHECKPOINT = 5, 10
N_EXAMPLES, HELD_OUT_SEED, HELD_OUT_EPISODES = 200, 1000, 120


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/scripted1500.h5"), help="collected where it is missing")
    parser.add_argument("--episodes-per-task", type=int, default=1500, help="to collect, where --data is missing")
    parser.add_argument("--examples-dir", type=Path, default=Path("data/examples"), help="likewise")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--steps", type=int, help="gradient steps (default: each config's)")
    parser.add_argument("--runs", type=Path, default=Path("runs/states_table"))
    parser.add_argument("--output", type=Path, default=ROOT / "results/ceborl_states.csv")
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()

    prepare_data(args.data, args.examples_dir, args.episodes_per_task, args.workers)
    # Seeds outside, so that a table that was stopped early is one of fewer seeds
    cells = [(method, task, seed) for seed in args.seeds for task in args.tasks for method in args.methods]
    runs = {" ".join(map(str, cell)): cell_run(args, *cell) for cell in cells}
    train_cells({label: run for label, run in runs.items() if not is_finished(run["output"], run)}, args.workers)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with args.output.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(FIELDS)
        for cell, run in zip(cells, runs.values(), strict=True):
            writer.writerows(cell_rows(cell, run))


def prepare_data(data: Path, examples_dir: Path, episodes_per_task: int, n_workers: int) -> None:
    """Collect the unlabelled data, and examples from episodes apart from them, where there are none."""
    held_out = examples_dir / "held_out.h5"
    missing = [task for task in TASKS if not examples_file(examples_dir, task).exists()]
    for path, n_episodes, seed in ((data, episodes_per_task, 0), (held_out, HELD_OUT_EPISODES, HELD_OUT_SEED)):
        if not path.exists() and (path == data or missing):
            path.parent.mkdir(parents=True, exist_ok=True)
            unfinished = path.with_suffix(".unfinished.h5")
            collect_scripted(unfinished, episodes_per_task=n_episodes, seed=seed, n_workers=n_workers, mode="w")
            unfinished.rename(path)
    for task in missing:
        examples, provenance = extract_examples(held_out, N_EXAMPLES, source=task, held_out=True)
        save_examples(examples_file(examples_dir, task), examples, OfflineDataset(held_out).observation_space, provenance)


def examples_file(folder: Path, task: str) -> Path:
    """:return: the success examples of a task"""
    return folder / f"state-{task}.h5"


def cell_run(args: argparse.Namespace, method: str, task: str, seed: int) -> dict[str, Any]:
    """:return: arguments of ``train`` for one cell of the table"""
    algo, config_name, changes = METHODS[method]
    config = {**load_config(config_name, ENV_ID), **changes}
    if args.steps:
        config["n_timesteps"] = args.steps
    spacing = config["n_timesteps"] // (2 * N_CHECKPOINTS)
    if spacing * 2 * N_CHECKPOINTS != config["n_timesteps"]:
        sys.exit(f"{config_name}: {config['n_timesteps']} steps are no multiple of {2 * N_CHECKPOINTS}; give such a --steps")
    first_seed = EVALUATION_SEED + 1000 * (1 + seed)
    return {
        "algo": algo,
        "env_id": ENV_ID,
        "config": config,
        "output": args.runs / method / f"{task}-seed{seed}",
        "dataset": str(args.data),
        "examples": None if algo == "bc" else str(examples_file(args.examples_dir, task)),
        "env_kwargs": {"task": task},
        "seed": seed,
        "eval_freq": spacing,
        "n_eval_episodes": EPISODES_A_CHECKPOINT,
        "eval_start": spacing * (N_CHECKPOINTS + 1),
        "eval_seeds": list(range(first_seed, first_seed + N_CHECKPOINTS)),
    }


def train_cells(runs: dict[str, dict[str, Any]], n_workers: int) -> None:
    """Train, and leave beside each run the commit it was made from, and what went wrong."""
    commit = current_commit()
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


def cell_rows(cell: tuple[str, str, int], run: dict[str, Any]) -> list[tuple]:
    """:return: of a finished cell its checkpoints; of a crashed one also those that it never reached, without episodes"""
    folder, failure = run["output"], run["output"] / "failure"
    if not is_finished(folder, run) and not failure.exists():
        return []
    _, config_name, changes = METHODS[cell[0]]
    config = " ".join([config_name, *(f"{key}={value}" for key, value in changes.items())])
    table = folder / "evaluations.csv"
    counts = (
        {int(row["step"]): (row["episodes"], row["successes"]) for row in csv.DictReader(table.open())}
        if table.exists()
        else {}
    )
    if failure.exists():
        config += f" (failed: {failure.read_text()})"
        for step in range(run["eval_start"], run["config"]["n_timesteps"] + 1, run["eval_freq"]):
            counts.setdefault(step, ("0", "0"))
    commit = (folder / "commit").read_text()
    return [(*cell, step, *count, config, commit) for step, count in sorted(counts.items())]


if __name__ == "__main__":
    main()
