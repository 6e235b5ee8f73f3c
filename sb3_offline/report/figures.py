"""The figures of a report."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np

from sb3_offline.data.files import replacing
from sb3_offline.report.episodes import PlayedEpisode
from sb3_offline.report.results import Results

matplotlib.use("Agg")
import matplotlib.pyplot as plt

FRAMES_PER_STRIP = 8
OUTCOME_COLORS = {True: "#1b7f4b", False: "#b3402e"}


def colors(results: Results) -> dict[str, tuple[float, float, float]]:
    """
    :param results: results of a grid
    :return: a color for each method
    """
    return dict(zip(results.methods, plt.get_cmap("tab10").colors * 10, strict=False))  # type: ignore[attr-defined]


def plot_table(results: Results, path: Path) -> None:
    """
    Draw a group of bars for each task and one for the means, with 95 % intervals, and the paper's rates as diamonds.

    :param results: results of a grid
    :param path: the PNG file
    """
    paper, groups, width = results.paper, [*results.tasks, "all"], 0.8 / len(results.methods)
    figure, axes = plt.subplots(figsize=(11, 3.8), layout="constrained")
    for position, (method, color) in enumerate(colors(results).items()):
        places = np.arange(len(groups)) + (position - (len(results.methods) - 1) / 2) * width
        for place, group in zip(places, groups, strict=True):
            entry = results.entries.get((method, group))
            if entry is not None:
                error = [[max(entry.rate - entry.interval[0], 0)], [max(entry.interval[1] - entry.rate, 0)]]
                axes.bar(place, entry.rate, width * 0.9, color=color, yerr=error, error_kw={"lw": 1, "ecolor": "0.3"})
            elif group == "all" and method in results.means:
                axes.bar(place, results.means[method], width * 0.9, color=color)
            if (method, group) in paper:
                axes.plot(place, paper[method, group], "D", color="black", markersize=4, markerfacecolor="white", zorder=5)
        axes.bar(0, 0, color=color, label=method)
    axes.plot([], [], "D", color="black", markersize=4, markerfacecolor="white", label="in the paper")
    axes.set_xticks(range(len(groups)), [*results.tasks, "mean"])
    axes.set(ylabel="success rate", ylim=(0, 1.03), title=results.name)
    axes.grid(axis="y", alpha=0.3)
    axes.set_axisbelow(True)
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    _save(figure, path)


def plot_curves(results: Results, path: Path) -> None:
    """
    Draw a panel for each task and a line for each method: the success rate at each checkpoint and its 95 % interval.

    :param results: results of a grid
    :param path: the PNG file
    """
    figure, panels = plt.subplots(
        1, len(results.tasks), figsize=(2.6 * len(results.tasks), 3.2), sharey=True, squeeze=False, layout="constrained"
    )
    for task, axes in zip(results.tasks, panels[0], strict=True):
        for method, color in colors(results).items():
            if (method, task) in results.entries:
                parts = results.entries[method, task].by("step")
                low, high = zip(*(part.interval for part in parts.values()), strict=True)
                axes.fill_between(list(parts), low, high, color=color, alpha=0.12, lw=0)
                axes.plot(list(parts), [part.rate for part in parts.values()], "-o", markersize=3, color=color)
        axes.set(title=task, ylim=(-0.03, 1.03), xlabel="gradient steps")
        axes.tick_params(axis="x", labelsize=7)
        axes.grid(alpha=0.3)
    panels[0][0].set_ylabel("success rate")
    handles = [plt.Line2D([], [], marker="o", markersize=3, color=color) for color in colors(results).values()]
    figure.legend(handles, list(colors(results)), loc="outside lower center", ncols=len(handles), frameon=False)
    _save(figure, path)


def plot_strips(episodes: Mapping[str, PlayedEpisode], title: str, path: Path) -> None:
    """
    Draw a row of frames for each method, evenly spaced over one episode.

    :param episodes: episodes by method
    :param title: title of the figure
    :param path: the image file
    """
    size = (1.15 * FRAMES_PER_STRIP + 1.2, 1.32 * len(episodes) + 0.5)
    figure, panels = plt.subplots(len(episodes), FRAMES_PER_STRIP, figsize=size, squeeze=False, layout="constrained")
    for (method, episode), row in zip(episodes.items(), panels, strict=True):
        chosen = np.linspace(0, len(episode.frames) - 1, FRAMES_PER_STRIP).round().astype(int)
        for axes, decision in zip(row, chosen, strict=True):
            axes.imshow(episode.frames[decision])
            axes.set(xticks=[], yticks=[])
            axes.set_title(f"decision {decision}", fontsize=7, pad=2)
            axes.spines[:].set_color(OUTCOME_COLORS[episode.solved])
        word = "solved" if episode.solved else "failed"
        row[0].set_ylabel(f"{method}\n{word}", fontsize=8, color=OUTCOME_COLORS[episode.solved])
    figure.suptitle(title, fontsize=10)
    _save(figure, path)


def plot_values(episodes: Mapping[tuple[str, str], PlayedEpisode], path: Path) -> None:
    """
    Draw the values of each state and action of the episodes, with a row for each method and a column for each task.

    :param episodes: episodes by method and task; those of methods without a critic are left out
    :param path: the PNG file
    """
    judged = {key: episode for key, episode in episodes.items() if episode.values}
    methods, tasks = ([*dict.fromkeys(key[place] for key in judged)] for place in (0, 1))
    size = (2.5 * len(tasks), 1.6 * len(methods) + 0.3)
    figure, panels = plt.subplots(len(methods), len(tasks), figsize=size, squeeze=False, layout="constrained")
    for method, row in zip(methods, panels, strict=True):
        for task, axes in zip(tasks, row, strict=True):
            axes.tick_params(labelsize=7)
            if method == methods[0]:
                axes.set_title(task, fontsize=9)
            if (method, task) not in judged:
                axes.set_axis_off()
                continue
            episode = judged[method, task]
            axes.plot(episode.values, color=OUTCOME_COLORS[episode.solved], lw=1.2)
            if episode.solved_at is not None:
                axes.axvline(episode.solved_at, color="0.4", ls=":", lw=1)
            axes.grid(alpha=0.3)
            if task == tasks[0]:
                axes.set_ylabel(f"{method}\n{episode.value_name}", fontsize=8)
    figure.supxlabel("decision", fontsize=9)
    _save(figure, path)


def _save(figure: plt.Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format=path.suffix[1:])
    plt.close(figure)
