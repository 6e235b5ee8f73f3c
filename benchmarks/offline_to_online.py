"""
From offline to online on Pendulum-v1: does the return collapse where stock SAC goes on from an offline policy?

    python benchmarks/offline_to_online.py

Stock SAC collects 3000 steps while it learns, and its replay buffer is the dataset. CQL and IQL learn from it and are
exported; stock SAC goes on in the environment, with half of each batch from the dataset, or with its own steps alone. SAC
from scratch stands beside them. Every 250 environment steps, the mode of the policy plays 20 episodes, the same ones each
time. Writes results/offline_to_online.csv and docs/images/offline_to_online.png; runs that the CSV file holds already are
not repeated.
"""

import argparse
import csv
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_offline import CQL, IQL, OfflineAlgorithm
from sb3_offline.common.online import export_sac

ROOT = Path(__file__).resolve().parent.parent
ENV_ID = "Pendulum-v1"
DATA_STEPS, GRADIENT_STEPS, ONLINE_STEPS, EVAL_FREQ, N_EPISODES = 3000, 3000, 2000, 250, 20
EVALUATION_SEED = 100_000
COMMON: dict[str, Any] = {"learning_rate": 1e-3}
NET_ARCH = {"net_arch": [64, 64]}
OFFLINE: dict[str, tuple[type[OfflineAlgorithm], dict[str, Any]]] = {
    "CQL": (CQL, {"cql_alpha": 1.0, "policy_kwargs": NET_ARCH}),
    "IQL": (IQL, {"policy_kwargs": {**NET_ARCH, "critic_layer_norm": True}}),
}
ALONE = "its own steps alone"
DATA_RATIOS = {"half of each batch from the dataset": 0.5, ALONE: 0.0}
SCRATCH = "SAC from scratch"


def collect(path: Path) -> None:
    """Save the replay buffer of a stock SAC that learns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    agent = SAC("MlpPolicy", ENV_ID, policy_kwargs=NET_ARCH, seed=0, device="cpu", **COMMON)
    agent.learn(DATA_STEPS).save_replay_buffer(path)


def mean_return(model: BaseAlgorithm) -> float:
    """:return: of the mode of the policy"""
    env = make_vec_env(ENV_ID, seed=EVALUATION_SEED)
    return float(evaluate_policy(model, env, N_EPISODES)[0])


def go_online(agent: SAC) -> list[float]:
    """:return: returns every EVAL_FREQ steps, before the first step too"""
    returns = [mean_return(agent)]
    for step in range(0, ONLINE_STEPS, EVAL_FREQ):
        agent.learn(EVAL_FREQ, reset_num_timesteps=step == 0)
        returns.append(mean_return(agent))
    return returns


def run(method: str, seed: int, data: Path) -> list[float]:
    """
    :param method: a key of ``methods()``
    :param seed: of weights, batches, and the environment
    :param data: the dataset
    :return: see ``go_online``
    """
    env = make_vec_env(ENV_ID, seed=seed)
    if method == SCRATCH:
        return go_online(SAC("MlpPolicy", env, policy_kwargs=NET_ARCH, seed=seed, device="cpu", **COMMON))
    name, data_ratio = methods()[method]
    algorithm, kwargs = OFFLINE[name]
    zip_path = data.with_name(f"{name}_{seed}.zip")
    model = algorithm("MlpPolicy", env, str(data), seed=seed, device="cpu", **COMMON, **kwargs)
    model.learn(GRADIENT_STEPS, log_interval=None)
    export_sac(model, zip_path, data_ratio=data_ratio)
    return go_online(SAC.load(zip_path, env=env))


def methods() -> dict[str, tuple[str, float]]:
    """:return: label to algorithm and ratio"""
    return {f"{name}, then SAC, {text}": (name, ratio) for text, ratio in DATA_RATIOS.items() for name in OFFLINE}


def plot(rows: list[dict[str, str]], path: Path) -> None:
    """Mean over the seeds, and the range from the lowest to the highest."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7.2, 4), layout="constrained")
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        steps = sorted({int(row["env_step"]) for row in own})
        returns = [[float(row["mean_return"]) for row in own if int(row["env_step"]) == step] for step in steps]
        color = {"CQL": "#1b6ca8", "IQL": "#1b7f4b"}.get(method[:3], "#777777")
        style = "-" if "dataset" in method else "--"
        axes.plot(steps, np.mean(returns, axis=1), style, color=color, label=method)
        axes.fill_between(steps, np.min(returns, axis=1), np.max(returns, axis=1), color=color, alpha=0.15, linewidth=0)
    axes.set(xlabel="environment steps after the switch", ylabel=f"return ({N_EPISODES} episodes)", xlim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--data", type=Path, default=Path("runs/offline_to_online/sac.pkl"), help="collected where missing")
    parser.add_argument("--output", type=Path, default=ROOT / "results" / "offline_to_online.csv")
    args = parser.parse_args()
    th.set_num_threads(1)
    if not args.data.exists():
        collect(args.data)
    rows: list[dict[str, Any]] = []
    if args.output.exists():
        with args.output.open() as file:
            rows = list(csv.DictReader(file))
    # With its own steps alone last, should it be stopped.
    for method in sorted([*methods(), SCRATCH], key=lambda name: name.endswith(ALONE)):
        for seed in args.seeds:
            if any(row["method"] == method and int(row["seed"]) == seed for row in rows):
                continue
            for index, value in enumerate(run(method, seed, args.data)):
                rows.append({"method": method, "seed": seed, "env_step": index * EVAL_FREQ, "mean_return": f"{value:.1f}"})
            with args.output.open("w", newline="") as file:
                writer = csv.DictWriter(file, list(rows[0]))
                writer.writeheader()
                writer.writerows(rows)
            print(method, seed, *(row["mean_return"] for row in rows[-1 - ONLINE_STEPS // EVAL_FREQ :]), flush=True)
    plot(rows, ROOT / "docs" / "images" / "offline_to_online.png")


if __name__ == "__main__":
    main()
