"""
Learners from examples on a point mass in the plane, whose data head for five goals alike; each task is told by 50 examples of
one goal.

    python benchmarks/goals_point_mass.py

Writes results/point_mass.csv: of the first three goals together, episodes solved by the policy's mode after each 500 gradient
steps. Variants that are in the file are not run again.
"""

import argparse
import csv
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_offline import ALGOS
from sb3_offline.experiment.evaluation import evaluate_success

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "tests"))
import point_mass  # noqa: E402

N_GOALS, TASKS, STEPS, EVAL_FREQ, N_EPISODES = 5, (0, 1, 2), 2500, 500, 20
ENV_ID = "TestPointMass-v0"
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "CEBORL": ("ceborl", {}),
    "RCE": ("rce", {}),
    "RCE, 10-step": ("rce", {"n_steps": 10}),
    "ORIL": ("oril", {}),
    "d-CQL": ("dcql", {}),
}


def successes(algo: str, change: dict[str, Any], goal: int, data: Path, seed: int) -> list[int]:
    """:return: episodes solved after each EVAL_FREQ gradient steps"""
    model = ALGOS[algo](
        "MlpPolicy",
        ENV_ID,
        str(data),
        examples=point_mass.goal_examples(goal=goal),
        n_action_samples=4,
        seed=seed,
        device="cpu",
        policy_kwargs={"net_arch": [64, 64]},
        **change,
    )
    solved = []
    for step in range(0, STEPS, EVAL_FREQ):
        model.learn(EVAL_FREQ, log_interval=None, reset_num_timesteps=step == 0)
        solved.append(sum(evaluate_success(model, ENV_ID, {"goal": goal}, N_EPISODES).successes))
    return solved


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", type=Path, default=Path("runs/point_mass/five_goals.h5"))
    parser.add_argument("--output", type=Path, default=ROOT / "results" / "point_mass.csv")
    args = parser.parse_args()
    th.set_num_threads(1)
    angles = 2 * np.pi * np.arange(N_GOALS) / N_GOALS
    point_mass.GOALS = (0.8 * np.stack([np.cos(angles), np.sin(angles)], axis=1)).astype(np.float32)
    args.data.parent.mkdir(parents=True, exist_ok=True)
    args.data.unlink(missing_ok=True)
    point_mass.write_point_mass(args.data)
    rows: list[dict[str, Any]] = []
    if args.output.exists():
        with args.output.open() as file:
            rows = [row for row in csv.DictReader(file) if row["variant"] in VARIANTS]
    for variant, (algo, change) in VARIANTS.items():
        if any(row["variant"] == variant for row in rows):
            continue
        by_goal = [successes(algo, change, goal, args.data, args.seed) for goal in TASKS]
        print(variant, *by_goal, flush=True)
        said = ", ".join(f"{name}={value}" for name, value in change.items()) or "the defaults"
        for index, solved in enumerate(zip(*by_goal, strict=True), start=1):
            counts = {"successes": sum(solved), "episodes": N_EPISODES * len(TASKS)}
            rows.append({"variant": variant, "change": said, "step": index * EVAL_FREQ, **counts})
        with args.output.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
