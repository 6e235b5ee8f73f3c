"""
Gather the learning curves of `sb3-offline train-sac` in results/sac_curves/ and draw them.

    python benchmarks/sac_curves.py runs/base runs/explore

Without a folder, it only draws what is there.
"""

import argparse
import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from sb3_offline.envs.multimodal_metaworld import TASKS

ROOT = Path(__file__).resolve().parent.parent
CURVES = ROOT / "results/sac_curves"
FIGURE = ROOT / "docs/images/sac_curves.png"


def gather(runs: list[Path]) -> None:
    """:param runs: folders of train-sac; each task's file gets the rows of them all, with the folder's name"""
    CURVES.mkdir(parents=True, exist_ok=True)
    for task in TASKS:
        rows: list[dict[str, str]] = []
        for run in runs:
            if (run / task / "curve.csv").exists():
                with (run / task / "curve.csv").open() as file:
                    rows += [{"run": run.name, **row} for row in csv.DictReader(file)]
        with (CURVES / f"{task}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def draw() -> None:
    """Success of evaluation episodes over decisions, a panel a task, a line a run."""
    figure, panels = plt.subplots(1, len(TASKS), figsize=(13, 2.8), sharey=True, layout="constrained")
    colours: dict[str, str] = {}
    for task, panel in zip(TASKS, panels, strict=True):
        with (CURVES / f"{task}.csv").open() as file:
            rows = list(csv.DictReader(file))
        for run in dict.fromkeys(row["run"] for row in rows):
            own = [row for row in rows if row["run"] == run]
            steps = [int(row["step"]) / 1000 for row in own]
            rates = [int(row["successes"]) / int(row["episodes"]) for row in own]
            colour = colours.setdefault(run, f"C{len(colours)}")
            panel.plot(steps, rates, color=colour, label=run, marker=".", markersize=4, linewidth=1.2)
        panel.set(title=task, xlabel="thousand decisions", ylim=(-0.03, 1.03))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("solved, of 20 episodes")
    handles = [plt.Line2D([], [], color=colour, label=run) for run, colour in colours.items()]
    panels[-1].legend(handles=handles, fontsize=8)
    FIGURE.parent.mkdir(exist_ok=True)
    figure.savefig(FIGURE, dpi=110)
    print(f"Saved {FIGURE}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path)
    arguments = parser.parse_args()
    if arguments.runs:
        gather(arguments.runs)
    draw()
