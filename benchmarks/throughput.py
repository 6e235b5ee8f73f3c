"""
Measure how long a gradient step takes in this library, in d3rlpy and in Stable-Baselines3.

    pip install --no-deps d3rlpy==2.8.1
    python benchmarks/throughput.py

Every learner takes whole steps, including sampling, on the same random transitions (batch 256; 256 examples; K = 16; images of
64x64x3; PyTorch's default number of threads). In one process, the learners take turns for several rounds, with a few steps
each. A time is the median over all steps. A ratio is the median of peer / ours over the rounds, given with its quartiles. The
results go to results/throughput.json and docs/images/throughput.png. Run nothing else on the machine meanwhile.
"""

import argparse
import json
import platform
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from torch.utils.flop_counter import FlopCounterMode

from sb3_offline import ALGOS
from sb3_offline.common.fast import operators
from sb3_offline.common.process import prepare_process
from sb3_offline.data.writer import DatasetWriter

RESULTS = Path("results/throughput.json")
FIGURE = Path("docs/images/throughput.png")
ACTIONS = spaces.Box(-1, 1, (4,), np.float32)
OBSERVATIONS = {
    "states": spaces.Box(-2, 2, (21,), np.float32),
    "pixels": spaces.Box(0, 255, (64, 64, 3), np.uint8),
}
BATCH_SIZE = N_EXAMPLES = 256
EPISODES, EPISODE_LENGTH = 100, 50
LAYERS = [256, 256]

Step = Callable[[], Any]


class RandomEnv(gym.Env):
    """Fills the replay buffer of SB3's SAC."""

    def __init__(self, observation_space: spaces.Box):
        self.observation_space, self.action_space = observation_space, ACTIONS

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        return self.observation_space.sample(), 0.0, False, False, {}


def write_transitions(path: Path, space: spaces.Box) -> tuple[np.ndarray, np.ndarray]:
    """:return: observations and actions of all episodes, in order, without the last observation of each episode"""
    rng = np.random.default_rng(0)
    observations, actions = [], []
    with DatasetWriter(path, space, ACTIONS, success=False) as writer:
        for _ in range(EPISODES):
            shape = (EPISODE_LENGTH + 1, *space.shape)
            pixels = space.dtype == np.uint8
            episode = rng.integers(0, 256, shape, np.uint8) if pixels else rng.uniform(-2, 2, shape).astype(np.float32)
            observations.append(episode)
            actions.append(rng.uniform(-1, 1, (EPISODE_LENGTH, 4)).astype(np.float32))
            writer.add_episode(episode, actions[-1], rewards=np.zeros(EPISODE_LENGTH, np.float32))
    return np.concatenate([episode[:-1] for episode in observations]), np.concatenate(actions)


def ours(algo: str, kind: str, data: Path, mixed_precision: bool, **kwargs: Any) -> BaseAlgorithm:
    policy = "CnnPolicy" if kind == "pixels" else "MlpPolicy"
    policy_kwargs = {"net_arch": LAYERS, "mixed_precision": mixed_precision}
    if algo in ("ceborl", "rce"):
        space, rng = OBSERVATIONS[kind], np.random.default_rng(1)
        kwargs["examples"] = (
            np.stack([space.sample() for _ in range(200)])
            if kind == "states"
            else rng.integers(0, 256, (200, *space.shape), np.uint8)
        )
        kwargs["example_batch_size"] = N_EXAMPLES
    model = ALGOS[algo](policy, None, dataset=str(data), batch_size=BATCH_SIZE, policy_kwargs=policy_kwargs, seed=0, **kwargs)
    model._setup_learn(1)
    return model


def sb3_sac(kind: str) -> BaseAlgorithm:
    policy = "CnnPolicy" if kind == "pixels" else "MlpPolicy"
    kwargs = {"net_arch": LAYERS}  # SB3's CnnPolicy has no hidden layers in its heads otherwise
    model = SAC(policy, RandomEnv(OBSERVATIONS[kind]), buffer_size=2000, policy_kwargs=kwargs, seed=0)
    return model.learn(101)


def one_step(model: Any, batch_size: int = BATCH_SIZE) -> Step:
    return lambda: model.train(1, batch_size)


def d3rlpy_cql(kind: str, observations: np.ndarray, actions: np.ndarray, n_action_samples: int) -> Step:
    import d3rlpy

    d3rlpy.logging.LOG.disabled = True
    if kind == "pixels":
        observations = np.ascontiguousarray(observations.transpose(0, 3, 1, 2))
    timeouts = np.zeros(len(actions))
    timeouts[EPISODE_LENGTH - 1 :: EPISODE_LENGTH] = 1
    zeros = np.zeros(len(actions), np.float32)
    dataset = d3rlpy.dataset.MDPDataset(observations, actions, zeros, zeros, timeouts)
    scaler = d3rlpy.preprocessing.PixelObservationScaler() if kind == "pixels" else None
    config = d3rlpy.algos.CQLConfig(batch_size=BATCH_SIZE, n_action_samples=n_action_samples, observation_scaler=scaler)
    algo = config.create(device=False)
    algo.build_with_dataset(dataset)
    return lambda: algo.update(dataset.sample_transition_batch(BATCH_SIZE))


def interleave(steps: dict[str, Step], rounds: int, seconds: float) -> dict[str, list[list[float]]]:
    """:return: for each learner and each round, the milliseconds that its steps took"""
    times: dict[str, list[list[float]]] = {name: [] for name in steps}
    for step in steps.values():  # Warm up.
        step()
    for _ in range(rounds):
        for name, step in steps.items():
            own: list[float] = []
            step()  # Not measured, because the caches still hold the data of the learner before.
            while not own or sum(own) < 1e3 * seconds:
                began = time.perf_counter()
                step()
                own.append(1e3 * (time.perf_counter() - began))
            times[name].append(own)
    return times


def comparison(name: str, times: dict[str, list[list[float]]], our: str, peer: str) -> dict[str, Any]:
    ratios = [np.median(theirs) / np.median(ours) for ours, theirs in zip(times[our], times[peer], strict=True)]
    low, high = np.quantile(ratios, (0.25, 0.75))
    entry: dict[str, Any] = {"name": name, "peer": peer}
    for prefix, learner in (("ours", our), ("peer", peer)):
        all_times = np.concatenate(times[learner])
        entry[f"{prefix}_ms"] = round(float(np.median(all_times)), 2)
        entry[f"{prefix}_ms_quartiles"] = [round(float(t), 2) for t in np.quantile(all_times, (0.25, 0.75))]
    return {
        **entry,
        "ratio": round(float(np.median(ratios)), 2),
        "ratio_quartiles": [round(float(low), 2), round(float(high), 2)],
    }


def _linear_flop(x_shape: Any, weight_shape: Any, *args: Any, out_shape: Any = None, **kwargs: Any) -> int:
    return 2 * int(np.prod(x_shape)) * weight_shape[0]


def product_rate(mixed_precision: bool) -> float:
    """:return: operations a second of one large product"""
    dtype = th.bfloat16 if mixed_precision else th.float32
    left, right = th.randn(4096, 256).to(dtype), th.randn(256, 256).to(dtype)
    return 2 * left.numel() * 256 / _fastest(lambda: operators.product(left, right))


def copy_rate() -> float:
    """:return: bytes a second of one large copy"""
    source = np.random.default_rng(0).integers(0, 256, 1 << 26, np.uint8)
    return source.nbytes / _fastest(lambda: source.copy())


def floor_entry(name: str, step: Step, median_ms: float, rate: float, copy_seconds: float) -> dict[str, Any]:
    """:return: the time of a step beside its floor: its operations at the rate of a large product, and copying the batch"""
    own = {operators._linear_pointwise: _linear_flop} if operators._linear_pointwise is not None else {}
    with FlopCounterMode(display=False, custom_mapping=own) as counter:
        step()
    floor = 1e3 * (counter.get_total_flops() / rate + copy_seconds)
    return {
        "name": f"floor_{name}",
        "ours_ms": round(median_ms, 2),
        "floor_ms": round(floor, 2),
        "gflop": round(counter.get_total_flops() / 1e9, 2),
        "gflop_per_second": round(rate / 1e9),
        "over_floor": round(median_ms / floor, 2),
    }


def _fastest(function: Callable[[], Any]) -> float:
    times = []
    for _ in range(30):
        began = time.perf_counter()
        function()
        times.append(time.perf_counter() - began)
    return min(times)


def measure(kind: str, folder: Path, rounds: int, seconds: float) -> list[dict[str, Any]]:
    data = folder / f"{kind}.h5"
    observations, actions = write_transitions(data, OBSERVATIONS[kind])
    k_of_cql = 16 if kind == "pixels" else 10  # actions of each of three kinds
    learners = {"ceborl": ("ceborl", {}), "cql": ("cql", {"n_action_samples": k_of_cql})}
    if kind == "states":
        others = ("rce", "bc", "iql", "td3_bc")
        learners.update({"in_sample": ("ceborl", {"beta": 0.0}), **{algo: (algo, {}) for algo in others}})
    steps: dict[str, Step] = {
        "SB3 SAC": one_step(sb3_sac(kind)),
        "d3rlpy CQL": d3rlpy_cql(kind, observations, actions, k_of_cql),
    }
    for name, (algo, kwargs) in learners.items():
        steps[name] = one_step(ours(algo, kind, data, False, **kwargs))
        steps[f"{name}_bf16"] = one_step(ours(algo, kind, data, True, **kwargs))
    times = interleave(steps, rounds, seconds)

    entries = []
    for suffix in ("", "_bf16"):
        entries.append(comparison(f"cql_{kind}_vs_d3rlpy{suffix}", times, f"cql{suffix}", "d3rlpy CQL"))
        for name in learners:
            if name != "cql":
                entries.append(comparison(f"{name}_{kind}_vs_sb3_sac{suffix}", times, f"{name}{suffix}", "SB3 SAC"))
    for name in learners:
        entries.append(comparison(f"{name}_{kind}_bf16_vs_float32", times, f"{name}_bf16", name))
    row_bytes = int(np.prod(OBSERVATIONS[kind].shape)) * OBSERVATIONS[kind].dtype.itemsize
    example_based = 2 * row_bytes * (3 * BATCH_SIZE + N_EXAMPLES)  # of CEBORL, read and written
    others = 2 * row_bytes * 2 * BATCH_SIZE
    rates, bandwidth = {"": product_rate(False), "_bf16": product_rate(True)}, copy_rate()
    for name in learners:
        copy_seconds = (example_based if name in ("ceborl", "in_sample", "rce") else others) / bandwidth
        for suffix, rate in rates.items():
            median = float(np.median(np.concatenate(times[name + suffix])))
            entries.append(floor_entry(f"{name}_{kind}{suffix}", steps[name + suffix], median, rate, copy_seconds))
    return entries


def draw(entries: list[dict[str, Any]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    compared = [entry for entry in entries if entry.get("peer") in ("SB3 SAC", "d3rlpy CQL")][::-1]
    figure, axes = plt.subplots(figsize=(7, 0.27 * len(compared) + 0.8))
    ratios = np.array([entry["ratio"] for entry in compared])
    quartiles = np.array([entry["ratio_quartiles"] for entry in compared])
    colors = ["tab:orange" if entry["name"].endswith("_bf16") else "tab:blue" for entry in compared]
    axes.barh(range(len(compared)), ratios, color=colors, xerr=np.abs(quartiles - ratios[:, None]).T)
    axes.set_yticks(range(len(compared)), [entry["name"] for entry in compared], fontsize=8)
    axes.axvline(1, color="black", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_xlabel("times as many steps a second as the peer (orange: bfloat16)")
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def merge(path: Path, entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Replace the entries of these names in the file."""
    old = json.loads(path.read_text()) if path.exists() else []
    names = {entry["name"] for entry in entries}
    merged = [entry for entry in old if entry["name"] not in names] + entries
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(merged, indent=1) + "\n")
    return merged


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=OBSERVATIONS, default=list(OBSERVATIONS))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=1.0, help="measured time of each learner in each round")
    parser.add_argument("--output", type=Path, default=RESULTS)
    args = parser.parse_args()
    prepare_process()
    machine = {
        "name": "machine",
        "cpu": th.cpu.get_capabilities().get("cpu_name", platform.processor()),
        "threads": th.get_num_threads(),
        "torch": th.__version__,
    }
    entries = [machine]
    with tempfile.TemporaryDirectory() as folder:
        for kind in args.kinds:
            entries += measure(kind, Path(folder), args.rounds, args.seconds)
    merged = merge(args.output, entries)
    if args.output == RESULTS:
        draw(merged, FIGURE)
    for entry in entries:
        print(json.dumps(entry))


if __name__ == "__main__":
    main()
