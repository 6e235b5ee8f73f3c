"""The figures of the demo."""

import csv
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np

from sb3_offline.data.files import replacing
from sb3_offline.demo.trajectories import JudgedTrajectories
from sb3_offline.envs import ENV_ID

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLORS = {True: "#1b7f4b", False: "#b3402e"}
FRAMES_PER_ATTEMPT = 6


def plot_learning_curves(runs: dict[str, Path], path: Path) -> None:
    """
    :param runs: folder of each run by label
    :param path: the PNG file
    """
    figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
    for (label, folder), style in zip(runs.items(), ("-o", "--s", ":^"), strict=False):
        with (folder / "evaluations.csv").open() as file:
            rows = list(csv.DictReader(file))
        rates = [int(row["successes"]) / int(row["episodes"]) for row in rows]
        axes.plot([int(row["step"]) for row in rows], rates, style, label=label, markersize=4)
    episodes = rows[0]["episodes"] if rows else 0
    axes.set(xlabel="gradient steps", ylabel=f"success rate ({episodes} episodes)", ylim=(-0.03, 1.03), xlim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=130, format=path.suffix[1:])
    plt.close(figure)


def plot_classifier(judged: JudgedTrajectories, pair: tuple[int, int], path: Path) -> None:
    """
    Draw the odds along a successful and a failed attempt, each with the spread of all attempts of its kind, and frames of
    both.

    :param judged: all trajectories
    :param pair: indices of the successful and the failed attempt
    :param path: the PNG file
    """
    n_decisions = judged.odds.shape[1]
    shown = np.linspace(0, n_decisions - 1, FRAMES_PER_ATTEMPT).round().astype(int)
    figure = plt.figure(figsize=(8, 6.4), layout="constrained")
    grid = figure.add_gridspec(3, FRAMES_PER_ATTEMPT, height_ratios=[2.4, 1, 1])
    axes = figure.add_subplot(grid[0, :])
    for index, solved in zip(pair, (True, False), strict=True):
        color, word = COLORS[solved], "successful" if solved else "failed"
        alike = judged.odds[judged.solved == solved]
        low, high = np.quantile(alike, (0.25, 0.75), axis=0)
        axes.fill_between(range(n_decisions), low, high, color=color, alpha=0.18, lw=0)
        axes.plot(judged.odds[index], color=color, label=f"{word} (band: middle half of all {len(alike)})")
        if solved:
            first = int(np.argmax(judged.success[index]))
            axes.axvline(first, color=color, ls=":", lw=1)
            axes.annotate(
                "solved", (first, 1), (4, -12), xycoords=("data", "axes fraction"), textcoords="offset points", color=color
            )
    axes.set(yscale="log", xlabel="decision", ylabel="odds C / (1 - C)", xlim=(0, n_decisions - 1))
    axes.set_title("The classifier along attempts that it did not learn from", fontsize=10)
    axes.legend(frameon=False, fontsize=9)
    env: Any = gym.make(ENV_ID, obs_type="state").unwrapped
    for row, (index, solved) in enumerate(zip(pair, (True, False), strict=True), start=1):
        env.reset(seed=int(judged.seeds[index]))
        for column, decision in enumerate(shown):
            env.scene.set_state(judged.scene_state[index, decision])
            panel = figure.add_subplot(grid[row, column])
            panel.imshow(env.get_image(200, 200))
            panel.set(xticks=[], yticks=[])
            panel.set_title(f"decision {decision}", fontsize=8, color=COLORS[solved])
            panel.spines[:].set_color(COLORS[solved])
    env.close()
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=120, format=path.suffix[1:])
    plt.close(figure)
