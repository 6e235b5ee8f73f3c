"""
RCE and CEBORL on a point mass in the plane, whose data head for five goals alike; each task is told by 50 examples of one.

    python benchmarks/goals_point_mass.py

Writes results/point_mass.csv: of the first three goals together, episodes solved by the policy's mode after each 500 gradient
steps.
"""

import argparse
import csv
import sys
from pathlib import Path

import numpy as np
import torch as th

from sb3_offline import ALGOS
from sb3_offline.experiment.evaluation import evaluate_success

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "tests"))
import point_mass  # noqa: E402

N_GOALS, TASKS, STEPS, EVAL_FREQ, N_EPISODES = 5, (0, 1, 2), 2500, 500, 20
ENV_ID = "TestPointMass-v0"


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
    rows = []
    for name in ("ceborl", "rce"):
        solved = dict.fromkeys(range(EVAL_FREQ, STEPS + 1, EVAL_FREQ), 0)
        for goal in TASKS:
            model = ALGOS[name](
                "MlpPolicy",
                ENV_ID,
                str(args.data),
                examples=point_mass.goal_examples(goal=goal),
                n_action_samples=4,
                seed=args.seed,
                device="cpu",
                policy_kwargs={"net_arch": [64, 64]},
            )
            for step in solved:
                model.learn(EVAL_FREQ, log_interval=None, reset_num_timesteps=step == EVAL_FREQ)
                solved[step] += sum(evaluate_success(model, ENV_ID, {"goal": goal}, N_EPISODES).successes)
            print(name, goal, solved, flush=True)
        episodes = N_EPISODES * len(TASKS)
        change = "the defaults"
        rows += [
            {"variant": name.upper(), "change": change, "step": step, "successes": n, "episodes": episodes}
            for step, n in solved.items()
        ]
    with args.output.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
