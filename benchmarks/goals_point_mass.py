"""
Learners from examples on a point mass in the plane; each task is told by 50 examples of one goal of five.

    python benchmarks/goals_point_mass.py

The data are of two kinds: attempts that head for the five goals alike, and play, pushes in any direction that are held for
five steps, so that the data hold every action. Writes results/point_mass.csv: of the first three goals together, episodes
solved by the policy's mode after each 500 gradient steps. Runs that are in the file are not repeated.
"""

import argparse
import csv
import itertools
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_offline import ALGOS
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.experiment.evaluation import evaluate_success

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "tests"))
import point_mass  # noqa: E402

N_GOALS, TASKS, STEPS, EVAL_FREQ, N_EPISODES = 5, (0, 1, 2), 2500, 500, 20
ENV_ID = "TestPointMass-v0"
FIVE_GOALS, PLAY = "five goals", "play"
VARIANTS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "CEBORL": (FIVE_GOALS, "ceborl", {}),
    "RCE": (FIVE_GOALS, "rce", {}),
    "RCE, 10-step": (FIVE_GOALS, "rce", {"n_steps": 10}),
    "ORIL": (FIVE_GOALS, "oril", {}),
    "d-CQL": (FIVE_GOALS, "dcql", {}),
    "CEBORL, play": (PLAY, "ceborl", {}),
    "RCE, play": (PLAY, "rce", {}),
}


def write_play(path: Path, n_episodes: int = 400) -> None:
    """Episodes that head for nothing."""
    rng, env = np.random.default_rng(0), point_mass.PointMass()
    spaces = (point_mass.STATES, point_mass.ACTIONS)
    with DatasetWriter(path, *spaces, env_id=ENV_ID, rewards=False, success=False) as writer:
        for index in range(n_episodes):
            pushes = np.repeat(rng.uniform(-1, 1, size=(point_mass.N_STEPS // 5, 2)), 5, axis=0)
            actions = np.clip(pushes + 0.3 * rng.normal(size=pushes.shape), -1, 1).astype(np.float32)
            observations = [env.reset(seed=index)[0], *(env.step(action)[0] for action in actions)]
            writer.add_episode(np.stack(observations), actions)


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
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS), metavar="VARIANT")
    parser.add_argument("--data", type=Path, default=Path("runs/point_mass"), help="folder, written anew")
    parser.add_argument("--output", type=Path, default=ROOT / "results" / "point_mass.csv")
    args = parser.parse_args()
    th.set_num_threads(1)
    angles = 2 * np.pi * np.arange(N_GOALS) / N_GOALS
    point_mass.GOALS = (0.8 * np.stack([np.cos(angles), np.sin(angles)], axis=1)).astype(np.float32)
    args.data.mkdir(parents=True, exist_ok=True)
    files = {data: args.data / f"{data.replace(' ', '_')}.h5" for data in (FIVE_GOALS, PLAY)}
    for data, write in ((FIVE_GOALS, point_mass.write_point_mass), (PLAY, write_play)):
        files[data].unlink(missing_ok=True)
        write(files[data])
    rows: list[dict[str, Any]] = []
    if args.output.exists():
        with args.output.open() as file:
            rows = [row for row in csv.DictReader(file) if row["variant"] in VARIANTS]
    done = {(row["variant"], int(row["seed"])) for row in rows}
    for seed, variant in itertools.product(args.seeds, args.variants):
        if (variant, seed) in done:
            continue
        data, algo, change = VARIANTS[variant]
        by_goal = [successes(algo, change, goal, files[data], seed) for goal in TASKS]
        print(variant, seed, *by_goal, flush=True)
        said = ", ".join(f"{name}={value}" for name, value in change.items()) or "the defaults"
        for index, solved in enumerate(zip(*by_goal, strict=True), start=1):
            counts = {"successes": sum(solved), "episodes": N_EPISODES * len(TASKS)}
            labels = {"variant": variant, "change": f"{data}; {said}", "seed": seed}
            rows.append({**labels, "step": index * EVAL_FREQ, **counts})
        with args.output.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
