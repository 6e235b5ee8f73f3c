"""
One change at a time from CEBORL's defaults, on state observations: what each part of the working form is worth.

    python benchmarks/ablation.py --data demo/data --task drawer-open

trains every variant on the data that `make demo` collected (finished ones are kept, so it can be stopped and started again)
and writes results/ablation_<task>.csv, one row a checkpoint. Nothing is chosen by its score.
"""

import argparse
import csv
from pathlib import Path
from typing import Any

from sb3_offline.ceborl import PAPER_FORM
from sb3_offline.experiment.config import load_config
from sb3_offline.experiment.parallel import train_in_parallel

ENV_ID = "MultimodalMetaworld-v0"
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "no penalty (beta = 0)": {"beta": 0.0},
    "1-step omega": {"n_steps": 1},
    "tau = 0.005": {"tau": 0.005},
    "odds start at 1": {"initial_odds": 1.0},
    "no examples among the data": {"example_share": 0.0},
    "standard deviations without a floor": {"policy_kwargs": {"features_extractor_kwargs": {"std_min": 1e-3}}},
    "omega with the policy's action": {"backup": "policy"},
    "policy maximises C": {"policy_extraction": "maximize"},
    "the paper's form": PAPER_FORM,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("demo/data"))
    parser.add_argument("--task", default="drawer-open")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--checkpoints", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--runs", type=Path, default=Path("runs/ablation"))
    args = parser.parse_args()

    folders = {name: args.runs / args.task / f"{index}-seed{args.seed}" for index, name in enumerate(VARIANTS)}
    runs = {
        name: {
            "algo": "ceborl",
            "env_id": ENV_ID,
            "config": {**load_config("ceborl", ENV_ID), "n_timesteps": args.steps, **VARIANTS[name]},
            "output": folders[name],
            "dataset": str(next(args.data.glob("dataset-state-*.h5"))),
            "examples": str(next(args.data.glob(f"examples-state-{args.task}-*.h5"))),
            "env_kwargs": {"task": args.task},
            "seed": args.seed,
            "eval_freq": args.steps // args.checkpoints,
            "n_eval_episodes": args.episodes,
        }
        for name in args.variants
        if not (folders[name] / "model.zip").exists()
    }
    train_in_parallel(runs, args.workers)
    write_table(Path(f"results/ablation_{args.task}.csv"), folders, args)


def write_table(path: Path, folders: dict[str, Path], args: argparse.Namespace) -> None:
    """One row a checkpoint of every finished variant."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["variant", "change", "task", "seed", "step", "episodes", "successes"])
        for name, folder in folders.items():
            if (folder / "model.zip").exists():
                change = ", ".join(f"{key}={value}" for key, value in VARIANTS[name].items())
                for row in csv.DictReader((folder / "evaluations.csv").open()):
                    writer.writerow([name, change, args.task, args.seed, row["step"], row["episodes"], row["successes"]])


if __name__ == "__main__":
    main()
