"""
One change at a time from CEBORL's config, on state observations: what each part of the working form is worth.

    sb3-offline collect-sac data/sac_states.h5 --examples data/sac_states_examples
    python benchmarks/ablation.py

trains every variant for 2000 gradient steps (finished ones are kept, so it can be stopped and started again) and writes
results/ablation.csv, one row a checkpoint, and docs/images/ablation.png. The protocol stands in
sb3_offline/benchmark/grid.py. Nothing is chosen by its score.
"""

import argparse
import csv
import functools
from pathlib import Path
from typing import Any

from sb3_offline.benchmark.grid import Grid, Method, plan
from sb3_offline.benchmark.local import train_locally
from sb3_offline.benchmark.runner import run_grid
from sb3_offline.benchmark.table import write_table
from sb3_offline.ceborl import PAPER_FORM
from sb3_offline.envs import ENV_ID
from sb3_offline.envs.multimodal_metaworld import TASKS
from sb3_offline.experiment.evaluation import success_interval

ROOT = Path(__file__).resolve().parent.parent

#: What is changed, by what it belongs to.
GROUPS: dict[str, dict[str, dict[str, Any]]] = {
    "default": {"default": {}},
    "penalty (a)": {
        "no penalty (beta = 0)": {"beta": 0.0},
        "beta = 0.01": {"beta": 0.01},
        "beta = 1": {"beta": 1.0},
        "beta = 10": {"beta": 10.0},
        "penalty on logits": {"penalty_space": "logit"},
        "mu: half policy, half uniform": {"mu": "mixture"},
        "mu: policy": {"mu": "policy"},
        "16 sampled actions": {"n_action_samples": 16},
    },
    "odds": {
        "odds start at 1": {"initial_odds": 1.0},
        "no examples among the data": {"example_share": 0.0},
    },
    "backup": {
        "gamma = 0.99": {"gamma": 0.99},
        "1-step omega": {"n_steps": 1},
        "3-step omega": {"n_steps": 3},
        "omega with the policy's action": {"backup": "policy"},
        "omega of states: expectile 0.9": {"backup": "expectile"},
        "tau = 0.005": {"tau": 0.005},
    },
    "networks": {
        "LayerNorm in the critics": {"policy_kwargs": {"critic_layer_norm": True}},
        "four critics": {"policy_kwargs": {"n_critics": 4}},
        "standard deviations without a floor": {"policy_kwargs": {"features_extractor_kwargs": {"std_min": 1e-3}}},
    },
    "policy": {
        "weighted by the classifier's odds": {"advantage": "value"},
        "all states count alike": {"state_exponent": 0.0},
        "policy maximises C": {"policy_extraction": "maximize"},
        "temperature 0.1": {"temperature": 0.1},
        "temperature 1": {"temperature": 1.0},
    },
    "all at once": {"the paper's form": PAPER_FORM},
}
VARIANTS = {name: change for group in GROUPS.values() for name, change in group.items()}


FIELDS = ("group", "variant", "task", "seed", "step", "episodes", "successes", "config", "commit", "versions")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="data/sac_states.h5")
    parser.add_argument("--examples", default="data/sac_states_examples/{task}.h5")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=["dial-turn", "door-open"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS), metavar="VARIANT")
    parser.add_argument("--runs", type=Path, default=Path("runs/ablation"))
    parser.add_argument("--output", type=Path, default=ROOT / "results/ablation.csv")
    parser.add_argument("--figure", type=Path, default=ROOT / "docs/images/ablation.png")
    parser.add_argument("--no-training", action="store_true", help="write the table of the runs that are finished")
    args = parser.parse_args()

    grid = Grid(
        env=ENV_ID,
        methods={name: Method("ceborl", "ceborl", VARIANTS[name]) for name in args.variants},
        tasks=args.tasks,
        seeds=args.seeds,
        n_timesteps=2000,
        dataset=args.data,
        examples=args.examples,
    )
    train = None if args.no_training else functools.partial(train_locally, n_workers=args.workers)
    table = args.runs / "table.csv"
    for line in run_grid(grid, plan(grid, args.runs), table, train):
        write_variants(table, args.output)
        print(line, flush=True)
    plot(args.output, args.figure)


def write_variants(table: Path, output: Path) -> None:
    """
    :param table: CSV file of a grid whose methods are variants
    :param output: gets it with the group of each
    """
    groups = {name: group for group, members in GROUPS.items() for name in members}
    with table.open(newline="") as file:
        rows = [{"variant": row.pop("method"), **row} for row in csv.DictReader(file)]
    write_table(output, [{"group": groups[row["variant"]], **row} for row in rows], FIELDS)


def plot(table: Path, figure: Path) -> None:
    """A panel a task, a bar a variant with the 95 % interval, and a line at the default."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with table.open() as file:
        rows = list(csv.DictReader(file))
    tasks, variants = (list(dict.fromkeys(row[key] for row in rows)) for key in ("task", "variant"))
    group_of = {row["variant"]: row["group"] for row in rows}
    colours = dict(zip(dict.fromkeys(group_of.values()), plt.get_cmap("tab10").colors, strict=False))  # type: ignore[attr-defined]
    _, panels = plt.subplots(
        1, len(tasks), figsize=(3.2 + 3.2 * len(tasks), 0.8 + 0.24 * len(variants)), sharey=True, squeeze=False
    )
    for panel, task in zip(panels[0], tasks, strict=True):
        for place, variant in enumerate(variants):
            own = [row for row in rows if row["task"] == task and row["variant"] == variant]
            solved, episodes = (sum(int(row[key]) for row in own) for key in ("successes", "episodes"))
            if not own:
                panel.text(0.01, place, "not run", va="center", fontsize=8)
                continue
            rate, (low, high) = solved / episodes, success_interval(solved, episodes)
            error = [[max(rate - low, 0.0)], [max(high - rate, 0.0)]]
            panel.barh(place, rate, xerr=error, color=colours[group_of[variant]], ecolor="0.3", capsize=2, height=0.7)
            if variant == "default":
                panel.axvline(rate, color="0.3", linestyle="--", linewidth=1)
        panel.set(title=task, xlim=(0, 1.02), xlabel="success rate", yticks=range(len(variants)), yticklabels=variants)
    panels[0][0].invert_yaxis()  # they share it
    plt.tight_layout()
    figure.parent.mkdir(parents=True, exist_ok=True)
    plt.savefig(figure, dpi=110)
    plt.close()


if __name__ == "__main__":
    main()
