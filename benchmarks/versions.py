"""
Compare the speed of training steps in another checkout of this library and in this one. Both run in turn, in one process of
one thread.

    git worktree add /tmp/before HEAD~5
    python benchmarks/versions.py /tmp/before ceborl ceborl_bf16 cql_bf16 in_sample_bf16

The program measures the processor time of the thread, which depends less on other processes than wall time does. It prints the
median and the quartiles of the ratio before / after, over pairs of a few steps each. `in_sample` is CEBORL with beta = 0.
"""

import argparse
import importlib
import sys
import tempfile
import time
from pathlib import Path
from types import ModuleType

import numpy as np
import torch as th

STEPS = {"states": 4, "pixels": 1}


def load(checkout: Path) -> ModuleType:
    """
    :param checkout: folder of a checkout
    :return: the module ``throughput.py`` in this folder, imported with the library of that checkout
    """
    for name in [name for name in sys.modules if name.split(".")[0] in ("sb3_offline", "throughput")]:
        del sys.modules[name]
    sys.path.insert(0, str(checkout.resolve()))
    try:
        return importlib.import_module("throughput")
    finally:
        del sys.path[0]


def milliseconds(model: object, steps: int, batch_size: int) -> float:
    """
    :param model: a model
    :param steps: number of gradient steps to time
    :param batch_size: batch size
    :return: processor time of a step
    """
    model.train(1, batch_size)  # type: ignore[attr-defined]  (a first step, without timing, fills the caches)
    began = time.thread_time()
    for _ in range(steps):
        model.train(1, batch_size)  # type: ignore[attr-defined]
    return 1e3 * (time.thread_time() - began) / steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="folder of the other checkout")
    parser.add_argument("learners", nargs="+", help="names of algorithms, with the suffix _bf16 for bfloat16")
    parser.add_argument("--kind", choices=STEPS, default="states")
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument(
        "--batch-size", type=int, default=256, help="number of transitions in a batch, and of examples (default: 256)"
    )
    args = parser.parse_args()
    th.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data.h5"
        models: dict[str, list[object]] = {name: [] for name in args.learners}
        for checkout in (args.before, Path(__file__).parents[1]):
            throughput = load(checkout)
            throughput.prepare_process()
            if not data.exists():
                throughput.write_transitions(data, throughput.OBSERVATIONS[args.kind])
            for name, both in models.items():
                algo, kwargs = name.removesuffix("_bf16"), {}
                if algo == "in_sample":
                    algo, kwargs = "ceborl", {"beta": 0.0}
                both.append(throughput.ours(algo, args.kind, data, name.endswith("_bf16"), **kwargs))
                if algo in ("ceborl", "rce"):
                    both[-1].example_batch_size = args.batch_size  # type: ignore[attr-defined]
        steps = STEPS[args.kind]
        times = {name: np.empty((args.pairs, 2)) for name in models}
        for pair in range(args.pairs):
            for name, both in models.items():
                times[name][pair] = [milliseconds(model, steps, args.batch_size) for model in both]
    for name, pairs in times.items():
        (before, after), (low, ratio, high) = pairs.min(axis=0), np.quantile(pairs[:, 0] / pairs[:, 1], (0.25, 0.5, 0.75))
        print(
            f"{name}: {ratio:.2f} times as fast ({low:.2f} to {high:.2f}); at best {before:.2f} before, {after:.2f} ms after"
        )


if __name__ == "__main__":
    main()
