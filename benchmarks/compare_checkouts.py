"""
Train every algorithm for a few steps in two checkouts and compare the weights bit by bit: the check behind every refactoring.

    git worktree add /tmp/before HEAD~1
    python benchmarks/compare_checkouts.py /tmp/before .

Both checkouts train on the first one's sample datasets, on one thread, from states and from images. The script prints one line
a case and exits with 1 where a case differs. A case that only one checkout knows is named and is no difference.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

#: Constructor arguments of each case, by algorithm. The defaults of each algorithm are a case of their own.
VARIANTS: dict[str, dict[str, dict[str, Any]]] = {
    "ceborl": {
        "paper's form": {"backup": "policy", "policy_extraction": "maximize", "n_steps": 1, "initial_odds": 1.0},
        "expectile": {"backup": "expectile", "example_share": 0.0},
        "policy's odds": {"backup": "policy", "advantage": "value", "mu": "mixture", "penalty_space": "logit"},
        "no penalty": {"beta": 0.0, "n_steps": 1},
        "own encoder": {"policy_kwargs": {"share_features_extractor": False}},
        "dataset's odds": {"backup": "dataset"},
    },
    "rce": {"10 steps": {"n_steps": 10, "example_share": 0.02}},
    "cql": {"learned alpha": {"cql_alpha": "auto", "n_steps": 3}},
    "iql": {"3 steps": {"n_steps": 3}},
    "awac": {"4 samples": {"n_action_samples": 4, "n_steps": 3}},
    "rebrac": {"3 steps": {"n_steps": 3}},
    "td3_bc": {"own encoder": {"policy_kwargs": {"share_features_extractor": False}}},
    "oril": {"unlabelled": {"positive_prior": 0.3}},
    "dcql": {"mse": {"distance": "mse"}},
    "bc": {"likelihood": {"loss": "log_prob"}},
}
OBSERVATIONS = {"states": "MlpPolicy", "pixels": "CnnPolicy"}


def main() -> None:
    parser = argparse.ArgumentParser(description="Compare the weights that two checkouts learn")
    parser.add_argument("before", type=Path, help="root of a checkout")
    parser.add_argument("after", type=Path, help="root of another one")
    parser.add_argument("-n", "--n-steps", type=int, default=50, help="gradient steps of each case (default: 50)")
    parser.add_argument("--algos", nargs="+", help="some algorithms only")
    parser.add_argument("--observations", nargs="+", choices=OBSERVATIONS, default=list(OBSERVATIONS))
    parser.add_argument("--in-checkout", type=Path, help=argparse.SUPPRESS)  # the child process: train here, print hashes
    args = parser.parse_args()
    if args.in_checkout:
        print(json.dumps(train_all(args.in_checkout, args)))
        return
    before, after = (run_in(root.resolve(), args) for root in (args.before, args.after))
    n_different = 0
    for case in dict.fromkeys([*before, *after]):
        if case not in before or case not in after:
            outcome = f"only {'after' if case in after else 'before'}"
        else:
            outcome = "same" if before[case] == after[case] else "DIFFERENT"
        n_different += outcome == "DIFFERENT"
        print(f"{case:<40} {outcome}")
    print(f"{n_different} of {len({*before, *after})} cases differ after {args.n_steps} steps")
    sys.exit(n_different > 0)


def run_in(root: Path, args: argparse.Namespace) -> dict[str, str]:
    """
    :param root: of a checkout
    :param args: of the command line
    :return: what :func:`train_all` gives with this checkout's code
    """
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder) / "sb3_offline"  # laid out as it is when installed
        package.mkdir()
        for path in [*(root / "sb3_offline").iterdir(), root / "data_tools", root / "zoo_configs"]:
            if not (package / path.name).exists():
                (package / path.name).symlink_to(path)
        samples = args.before.resolve() / "data_tools" / "samples"
        command = [sys.executable, __file__, str(args.before), str(args.after), "--in-checkout", str(samples)]
        command += ["--n-steps", str(args.n_steps), "--observations", *args.observations]
        command += ["--algos", *args.algos] if args.algos else []
        environment = {**os.environ, "PYTHONPATH": folder, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True, check=True)
        return json.loads(done.stdout.splitlines()[-1])


def train_all(samples: Path, args: argparse.Namespace) -> dict[str, str]:
    """
    :param samples: folder of the sample datasets
    :param args: of the command line
    :return: a hash of each case's weights and optimizer states
    """
    from sb3_offline import ALGOS

    hashes = {}
    for kind in args.observations:
        dataset = samples / f"sac_{kind}.h5"
        examples = success_examples(dataset)
        for name in args.algos or ALGOS:
            for variant, settings in {"": {}, **VARIANTS.get(name, {})}.items():
                if name in ("ceborl", "rce", "oril", "dcql"):
                    settings = {"examples": examples, **settings}
                elif name != "bc":
                    settings = {"reward_fn": "success", **settings}  # the samples hold no rewards
                if name == "oril":
                    settings = {"reward_steps": 20, **settings}
                if kind == "pixels":
                    settings = {"random_shift": 2, "batch_size": 32, **settings}
                model = ALGOS[name](OBSERVATIONS[kind], None, str(dataset), seed=1, **settings)
                model.learn(args.n_steps, log_interval=None)
                hashes[f"{name} {kind} {variant}".strip()] = hash_of(model)
    return hashes


def success_examples(dataset: Path) -> Any:
    """:return: the observations after each successful step of the drawer, as an array"""
    import numpy as np

    from sb3_offline.data.reader import OfflineDataset

    data = OfflineDataset(dataset)
    rows = []
    for episode in np.flatnonzero(data.source == data.sources.index("drawer-open")):
        steps = data.step_starts[episode] + np.arange(data.lengths[episode])
        rows += (data.observation_starts[episode] + 1 + np.flatnonzero(data.success[steps])).tolist()
    return np.asarray(data.observations[np.array(rows)])


def hash_of(model: Any) -> str:
    """:return: SHA-256 of all tensors that the model saves"""
    digest = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, dict):
            for key in sorted(value, key=str):
                digest.update(str(key).encode())
                add(value[key])
        elif isinstance(value, list | tuple):
            for part in value:
                add(part)
        elif hasattr(value, "detach"):
            digest.update(value.detach().cpu().contiguous().numpy().tobytes())

    add(model.get_parameters())
    return digest.hexdigest()


if __name__ == "__main__":
    main()
