"""
CQL, IQL and TD3+BC beside those of d3rlpy: the same data, networks, hyperparameters, budget and seeds.

    python benchmarks/compare_d3rlpy.py

collects the dataset (all steps that SB3's SAC takes while it learns Pendulum-v1), trains with both libraries, plays 10
episodes with each final policy, the same ones for all, and writes results/compare_d3rlpy.csv. Rows that are there are kept, so
it can be stopped and started again. d3rlpy has to be installed, see CONTRIBUTING.md.
"""

import argparse
import csv
from pathlib import Path
from typing import Any

import d3rlpy
import gymnasium as gym
import numpy as np
import torch as th
from d3rlpy.logging import NoopAdapterFactory
from d3rlpy.preprocessing import MinMaxActionScaler, StandardObservationScaler
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_offline import CQL, IQL, TD3BC
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.experiment.evaluation import EVALUATION_SEED

ENV_ID, EPISODE_STEPS = "Pendulum-v1", 200
FIELDS = ("algorithm", "library", "seed", "gradient_steps", "episodes", "mean_return", "std_return")
#: Rewards are divided by this: values of some hundreds take networks long to reach.
REWARD_DIVISOR = 10.0
#: Of both libraries. Small and fast: the question is whether they agree, not how far they get.
BATCH_SIZE, LEARNING_RATE, TAU, GAMMA, N_ACTION_SAMPLES = 128, 1e-3, 0.02, 0.95, 4
ROOT = Path(__file__).resolve().parent.parent

OURS: dict[str, tuple[Any, dict[str, Any]]] = {
    "CQL": (CQL, {"cql_alpha": 1.0, "n_action_samples": N_ACTION_SAMPLES}),
    "IQL": (IQL, {}),
    "TD3+BC": (TD3BC, {}),
}
THEIRS: dict[str, tuple[Any, dict[str, Any]]] = {
    # No learning rate of alpha: it stays at 1. The factor in front of the penalty is another argument there.
    "CQL": (
        d3rlpy.algos.CQLConfig,
        {
            "conservative_weight": 1.0,
            "alpha_learning_rate": 0.0,
            "temp_learning_rate": LEARNING_RATE,
            "n_action_samples": N_ACTION_SAMPLES,
        },
    ),
    "IQL": (d3rlpy.algos.IQLConfig, {}),
    "TD3+BC": (d3rlpy.algos.TD3PlusBCConfig, {}),
}


def collect(path: Path, n_steps: int) -> None:
    """Everything that stock SAC meets while it learns: bad, middling and good episodes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    env = gym.make(ENV_ID)
    model = SAC("MlpPolicy", env, learning_rate=1e-3, buffer_size=n_steps, seed=0).learn(n_steps)
    buffer = model.replay_buffer
    assert buffer is not None
    with DatasetWriter(path, env.observation_space, env.action_space, env_id=ENV_ID, mode="w", success=False) as writer:
        for first in range(0, n_steps, EPISODE_STEPS):
            steps = slice(first, first + EPISODE_STEPS)
            observations = np.concatenate([buffer.observations[steps, 0], buffer.next_observations[steps, 0][-1:]])
            actions = model.policy.unscale_action(buffer.actions[steps, 0])
            writer.add_episode(observations, actions, rewards=buffer.rewards[steps, 0] / REWARD_DIVISOR)


def train_ours(name: str, path: Path, n_steps: int, seed: int) -> Any:
    """:return: the trained model"""
    algorithm, settings = OURS[name]
    model = algorithm(
        "MlpPolicy",
        None,
        str(path),
        learning_rate=LEARNING_RATE,
        batch_size=BATCH_SIZE,
        tau=TAU,
        gamma=GAMMA,
        seed=seed,
        **settings,
    )
    return model.learn(n_steps, log_interval=None)


class TheirPolicy:
    """
    A policy of d3rlpy with SB3's ``predict``.

    :param algorithm: trained
    """

    def __init__(self, algorithm: Any):
        self.algorithm = algorithm

    def predict(self, observation: np.ndarray, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        return self.algorithm.predict(observation), None


def train_theirs(name: str, path: Path, n_steps: int, seed: int) -> TheirPolicy:
    """:return: the trained policy"""
    d3rlpy.seed(seed)
    dataset = OfflineDataset(path)
    steps = np.delete(np.arange(dataset.n_steps + dataset.n_episodes), dataset.observation_starts + dataset.lengths)
    data = d3rlpy.dataset.MDPDataset(
        observations=np.asarray(dataset.observations)[steps],
        actions=np.asarray(dataset.actions),
        rewards=np.asarray(dataset.rewards),
        terminals=np.asarray(dataset.terminated),
        timeouts=np.asarray(dataset.truncated),
    )
    config, settings = THEIRS[name]
    algorithm = config(
        actor_learning_rate=LEARNING_RATE,
        critic_learning_rate=LEARNING_RATE,
        batch_size=BATCH_SIZE,
        tau=TAU,
        gamma=GAMMA,
        **settings,
        observation_scaler=StandardObservationScaler(),
        action_scaler=MinMaxActionScaler(minimum=dataset.action_space.low, maximum=dataset.action_space.high),
    ).create()
    algorithm.fit(data, n_steps, n_steps, logger_adapter=NoopAdapterFactory(), show_progress=False)
    return TheirPolicy(algorithm)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/pendulum_replay.h5"), help="collected where it is missing")
    parser.add_argument("--data-steps", type=int, default=10_000)
    parser.add_argument("--steps", type=int, default=2000, help="gradient steps")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--output", type=Path, default=ROOT / "results" / "compare_d3rlpy.csv")
    args = parser.parse_args()

    if not args.data.exists():
        collect(args.data, args.data_steps)
    rows = []
    if args.output.exists():
        with args.output.open() as file:
            rows = list(csv.DictReader(file))
    done = {(row["algorithm"], row["library"], int(row["seed"])) for row in rows if int(row["gradient_steps"]) == args.steps}
    for seed in args.seeds:
        for name in OURS:
            for library, train in (("sb3-offline", train_ours), ("d3rlpy", train_theirs)):
                if (name, library, seed) in done:
                    continue
                policy = train(name, args.data, args.steps, seed)
                env = make_vec_env(ENV_ID, seed=EVALUATION_SEED)
                returns, _ = evaluate_policy(policy, env, args.episodes, return_episode_rewards=True)
                values = (name, library, seed, args.steps, args.episodes, f"{np.mean(returns):.1f}", f"{np.std(returns):.1f}")
                rows.append(dict(zip(FIELDS, map(str, values), strict=True)))
                with args.output.open("w", newline="") as file:
                    writer = csv.DictWriter(file, FIELDS, lineterminator="\n")
                    writer.writeheader()
                    writer.writerows(rows)
                print(*values, flush=True)


if __name__ == "__main__":
    th.set_num_threads(1)
    main()
