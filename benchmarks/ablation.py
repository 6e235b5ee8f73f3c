"""
One change at a time from CEBORL's defaults, on state observations: what each part of the working form is worth.

    python benchmarks/ablation.py --data data/scripted1500.h5 --examples-dir data/examples --tasks door-open plate-slide

collects data and examples where they are missing, trains every variant (finished ones are kept, so it can be stopped and
started again) and writes results/ablation.csv, one row a checkpoint, and docs/images/ablation.png. The protocol stands in
benchmarks/cells.py. Nothing is chosen by its score.
"""

import argparse
import csv
from pathlib import Path
from typing import Any

from cells import ENV_ID, ROOT, add_arguments, cell_run, prepare_data, train_cells, write_rows

from sb3_offline.ceborl import PAPER_FORM
from sb3_offline.experiment.config import load_config
from sb3_offline.experiment.evaluation import success_interval

#: What is changed, by what it belongs to; a variant's folder is named by its place in its group.
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
    },
    "odds": {
        "class prior 0.1": {"class_prior": 0.1},
        "class prior 0.02": {"class_prior": 0.02},
        "omega at most 1": {"omega_max": 1.0},
        "omega at most 10": {"omega_max": 10.0},
        "odds start at 1": {"initial_odds": 1.0},
        "no examples among the data": {"example_share": 0.0},
    },
    "backup": {
        "1-step omega": {"n_steps": 1},
        "3-step omega": {"n_steps": 3},
        "30-step omega": {"n_steps": 30},
        "omega with the policy's action": {"backup": "policy"},
        "omega of states: expectile 0.7": {"backup": "expectile", "expectile": 0.7},
        "omega of states: expectile 0.9": {"backup": "expectile", "expectile": 0.9},
        "tau = 0.005": {"tau": 0.005},
    },
    "networks": {
        "LayerNorm in the critics": {"policy_kwargs": {"critic_layer_norm": True}},
        "one critic": {"policy_kwargs": {"n_critics": 1}},
        "four critics": {"policy_kwargs": {"n_critics": 4}},
        "standard deviations without a floor": {"policy_kwargs": {"features_extractor_kwargs": {"std_min": 1e-3}}},
    },
    "policy": {
        "policy maximises C": {"policy_extraction": "maximize"},
        "temperature 0.1": {"temperature": 0.1},
        "temperature 1": {"temperature": 1.0},
    },
    "all at once": {"the paper's form": PAPER_FORM},
}
VARIANTS = {name: change for group in GROUPS.values() for name, change in group.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser, "runs/ablation", "ablation.csv", ["door-open", "plate-slide"], [0])
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS), metavar="VARIANT")
    parser.add_argument("--figure", type=Path, default=ROOT / "docs/images/ablation.png")
    args = parser.parse_args()

    prepare_data(args)
    cells = []
    for seed, name, task in ((seed, name, task) for seed in args.seeds for name in args.variants for task in args.tasks):
        run = cell_run(args, "ceborl", changed(load_config("ceborl", ENV_ID), VARIANTS[name]), folder_name(name), task, seed)
        group = next(group for group, members in GROUPS.items() if name in members)
        change = ", ".join(f"{key}={value}" for key, value in VARIANTS[name].items())
        cells.append(({"group": group, "variant": name, "task": task, "seed": seed, "config": change}, run))
    if not args.no_training:
        train_cells([run for _, run in cells], args.workers)
    write_rows(args.output, cells)
    plot(args.output, args.figure)


def folder_name(variant: str) -> str:
    """:return: the variant's name without what folders should not have"""
    return "".join(letter if letter.isalnum() or letter == "." else "-" for letter in variant)


def changed(config: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """:return: the config with the change in it, where dicts are joined"""
    return {
        **config,
        **{key: changed(config.get(key, {}), new) if isinstance(new, dict) else new for key, new in change.items()},
    }


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
