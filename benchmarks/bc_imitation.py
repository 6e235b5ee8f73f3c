"""
Does BC reach the expert's return? On the Pendulum rollouts in the source distribution of imitation 1.0.1.

    python benchmarks/bc_imitation.py

Writes results/bc_imitation.csv: a row for the expert's episodes, and one a seed of BC.
"""

import argparse
import csv
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th
from sdist import fetch
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_offline import BC
from sb3_offline.data.convert import convert
from sb3_offline.data.reader import OfflineDataset

ROOT = Path(__file__).resolve().parent.parent
ENV_ID, GRADIENT_STEPS, N_EPISODES, EVALUATION_SEED = "Pendulum-v1", 5000, 100, 100_000
ROLLOUTS = Path("tests/testdata/expert_models/pendulum_0/rollouts/final.npz")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--folder", type=Path, default=Path("runs/imitation"), help="for the source distribution")
    parser.add_argument("--output", type=Path, default=ROOT / "results" / "bc_imitation.csv")
    args = parser.parse_args()
    th.set_num_threads(1)

    spec = gym.spec(ENV_ID)
    rollouts = OfflineDataset(
        fetch("imitation", "1.0.1", args.folder) / ROLLOUTS,
        action_space=gym.make(ENV_ID).action_space,
        max_episode_steps=spec.max_episode_steps,
    )
    data = args.folder / "pendulum.h5"
    convert(rollouts, data, overwrite=True, progress_bar=False)
    expert = np.add.reduceat(rollouts.rewards, rollouts.step_starts)
    rows = [summary("expert", "", 0, expert)]
    for seed in args.seeds:
        model = BC("MlpPolicy", ENV_ID, str(data), seed=seed, device="cpu").learn(GRADIENT_STEPS, log_interval=None)
        env = make_vec_env(ENV_ID, seed=EVALUATION_SEED)
        returns, _ = evaluate_policy(model, env, N_EPISODES, return_episode_rewards=True)
        rows.append(summary("BC", str(seed), GRADIENT_STEPS, np.array(returns)))
        print(rows[-1])
    with args.output.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def summary(policy: str, seed: str, gradient_steps: int, returns: np.ndarray) -> dict[str, str]:
    """:return: a row"""
    spread = {"mean_return": f"{returns.mean():.1f}", "std_return": f"{returns.std(ddof=1):.1f}"}
    return {"policy": policy, "seed": seed, "gradient_steps": str(gradient_steps), "episodes": str(len(returns)), **spread}


if __name__ == "__main__":
    main()
