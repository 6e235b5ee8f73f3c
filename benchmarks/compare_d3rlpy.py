"""
CQL, IQL and TD3+BC beside those of d3rlpy: the same data, networks, hyperparameters, budget and seeds. AWAC and ReBRAC too,
where `--algorithms` names them.

    python benchmarks/compare_d3rlpy.py

collects the dataset (all steps that SB3's SAC takes while it learns Pendulum-v1), trains with both libraries, and writes
results/compare_d3rlpy.csv. Runs that are there are kept, so it can be stopped and started again. d3rlpy has to be installed,
see CONTRIBUTING.md.

The protocol, fixed before the runs of the file: five seeds, 4000 gradient steps; after each 500 the policy's mode plays 20
episodes, the same ones for all. A run counts by the mean of its last three checkpoints. Two rows agree if 0 lies in the 95 %
interval of their difference (Welch's, over the seeds).

CQL stands there twice, since the next action of its target is a sample of the policy here (and in the authors' code), and the
policy's mode in d3rlpy: once both libraries sample, and once both take the mode. AWAC's target has an entropy term in d3rlpy,
which neither the paper nor the authors' code has; it is taken out.
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
from d3rlpy.models.torch import build_squashed_gaussian_distribution
from d3rlpy.preprocessing import MinMaxActionScaler, StandardObservationScaler
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_offline import AWAC, CQL, IQL, TD3BC, ReBRAC
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.experiment.evaluation import EVALUATION_SEED

ENV_ID, EPISODE_STEPS = "Pendulum-v1", 200
STEPS, EVAL_FREQ, N_EPISODES = 4000, 500, 20
FIELDS = ("algorithm", "library", "seed", "gradient_steps", "mean_return")
#: Rewards are divided by this: values of some hundreds take networks long to reach.
REWARD_DIVISOR = 10.0
#: Of both libraries. Small and fast: the question is whether they agree, not how far they get.
NET_ARCH, BATCH_SIZE, LEARNING_RATE, TAU, GAMMA, N_ACTION_SAMPLES = [64, 64], 128, 1e-3, 0.02, 0.95, 4
ROOT = Path(__file__).resolve().parent.parent
SAMPLE, MODE = "CQL, target at a sample", "CQL, target at the mode"


class ModeTargetCQL(CQL):
    """CQL with d3rlpy's target."""

    def _sample_actions(self, policy_features: th.Tensor, next_observations: Any) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        actions, log_densities, _ = super()._sample_actions(policy_features, next_observations)
        mean, _ = self.actor.gaussian_parameters(self.actor.encode(next_observations))
        return actions, log_densities, mean.tanh()


def sample_targets(impl: Any) -> None:
    """
    Give a CQL of d3rlpy our target.

    :param impl: its networks and losses
    """

    def target(batch: Any) -> th.Tensor:
        action = build_squashed_gaussian_distribution(impl.policy(batch.next_observations)).sample()
        return impl._targ_q_func_forwarder.compute_target(batch.next_observations, action, reduction="min")

    impl._compute_deterministic_target = target


CQL_SETTINGS = {"cql_alpha": 1.0, "n_action_samples": N_ACTION_SAMPLES}
OURS: dict[str, tuple[Any, dict[str, Any]]] = {
    SAMPLE: (CQL, CQL_SETTINGS),
    MODE: (ModeTargetCQL, CQL_SETTINGS),
    "IQL": (IQL, {}),
    "TD3+BC": (TD3BC, {}),
    "AWAC": (AWAC, {}),
    "ReBRAC": (ReBRAC, {}),
}
THEIR_CQL_SETTINGS = {
    # No learning rate of alpha: it stays at 1. The factor in front of the penalty is another argument there.
    "conservative_weight": 1.0,
    "alpha_learning_rate": 0.0,
    "temp_learning_rate": LEARNING_RATE,
    "n_action_samples": N_ACTION_SAMPLES,
}
THEIRS: dict[str, tuple[Any, dict[str, Any]]] = {
    SAMPLE: (d3rlpy.algos.CQLConfig, THEIR_CQL_SETTINGS),
    MODE: (d3rlpy.algos.CQLConfig, THEIR_CQL_SETTINGS),
    "IQL": (d3rlpy.algos.IQLConfig, {"value_encoder_factory": d3rlpy.models.VectorEncoderFactory(NET_ARCH)}),
    "TD3+BC": (d3rlpy.algos.TD3PlusBCConfig, {}),
    "AWAC": (d3rlpy.algos.AWACConfig, {}),
    "ReBRAC": (
        d3rlpy.algos.ReBRACConfig,
        {
            "critic_encoder_factory": d3rlpy.models.VectorEncoderFactory(NET_ARCH, use_layer_norm=True),
            "actor_beta": 0.01,
            "critic_beta": 0.01,
        },
    ),
}
#: Those of results/compare_d3rlpy.csv
FIRST = (SAMPLE, MODE, "IQL", "TD3+BC")


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


def mean_return(policy: Any) -> float:
    """:return: of the policy's mode"""
    env = make_vec_env(ENV_ID, n_envs=N_EPISODES, seed=EVALUATION_SEED)
    return float(evaluate_policy(policy, env, N_EPISODES)[0])


def train_ours(name: str, path: Path, seed: int) -> list[float]:
    """:return: returns after each EVAL_FREQ gradient steps"""
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
        device="cpu",
        policy_kwargs={"net_arch": NET_ARCH},
        **settings,
    )
    returns = []
    for step in range(0, STEPS, EVAL_FREQ):
        model.learn(EVAL_FREQ, log_interval=None, reset_num_timesteps=step == 0)
        returns.append(mean_return(model))
    return returns


class TheirPolicy:
    """
    A policy of d3rlpy with SB3's ``predict``.

    :param algorithm: trained
    """

    def __init__(self, algorithm: Any):
        self.algorithm = algorithm

    def predict(self, observation: np.ndarray, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        return self.algorithm.predict(observation), None


def train_theirs(name: str, path: Path, seed: int) -> list[float]:
    """:return: returns after each EVAL_FREQ gradient steps"""
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
    encoder = d3rlpy.models.VectorEncoderFactory(NET_ARCH)
    algorithm = config(
        actor_learning_rate=LEARNING_RATE,
        critic_learning_rate=LEARNING_RATE,
        batch_size=BATCH_SIZE,
        tau=TAU,
        gamma=GAMMA,
        **{"actor_encoder_factory": encoder, "critic_encoder_factory": encoder, **settings},
        observation_scaler=StandardObservationScaler(),
        action_scaler=MinMaxActionScaler(minimum=dataset.action_space.low, maximum=dataset.action_space.high),
    ).create()
    algorithm.build_with_dataset(data)
    if name == SAMPLE:
        sample_targets(algorithm.impl)
    if name == "AWAC":
        algorithm.impl.modules.log_temp._parameter.data.fill_(-th.inf)
    epochs = algorithm.fitter(data, STEPS, EVAL_FREQ, logger_adapter=NoopAdapterFactory(), show_progress=False)
    return [mean_return(TheirPolicy(algorithm)) for _ in epochs]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/pendulum_replay.h5"), help="collected where it is missing")
    parser.add_argument("--data-steps", type=int, default=10_000)
    parser.add_argument("--algorithms", nargs="+", choices=OURS, default=FIRST)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--output", type=Path, default=ROOT / "results" / "compare_d3rlpy.csv")
    args = parser.parse_args()

    if not args.data.exists():
        collect(args.data, args.data_steps)
    rows: list[dict[str, str]] = []
    if args.output.exists():
        with args.output.open() as file:
            rows = list(csv.DictReader(file))
    done = {(row["algorithm"], row["library"], int(row["seed"])) for row in rows if int(row["gradient_steps"]) == STEPS}
    # Runs of another protocol are dropped.
    rows = [row for row in rows if (row["algorithm"], row["library"], int(row["seed"])) in done]
    for seed in args.seeds:
        for name in args.algorithms:
            for library, train in (("sb3-offline", train_ours), ("d3rlpy", train_theirs)):
                if (name, library, seed) in done:
                    continue
                returns = train(name, args.data, seed)
                for index, value in enumerate(returns, start=1):
                    values = (name, library, str(seed), str(index * EVAL_FREQ), f"{value:.1f}")
                    rows.append(dict(zip(FIELDS, values, strict=True)))
                with args.output.open("w", newline="") as file:
                    writer = csv.DictWriter(file, FIELDS, lineterminator="\n")
                    writer.writeheader()
                    writer.writerows(rows)
                print(name, library, seed, *(f"{value:.1f}" for value in returns), flush=True)


if __name__ == "__main__":
    th.set_num_threads(1)
    main()
