"""The page of labels: a person looks at the frames at the threshold, where the classifier doubts most."""

import html
import os
from pathlib import Path
from typing import Any

import numpy as np

from sb3_offline.data.examples import load_examples
from sb3_offline.data.spaces import subspaces
from sb3_offline.data_tools.converting.render_dataset import draw_moments
from sb3_offline.data_tools.inspecting.joined_datasets import JoinedDatasets
from sb3_offline.data_tools.inspecting.page_charts import ACCENT, GOOD, NEUTRAL, histogram, png_uri, table
from sb3_offline.data_tools.inspecting.page_images import image_name, to_image
from sb3_offline.data_tools.inspecting.page_parts import details, section, tiles, write_document
from sb3_offline.envs import ENV_ID
from sb3_offline.labelling.episodes import EpisodeLabels, LabelCheck

SHOWN = 24
"""Number of episodes shown on each side of the threshold, and number of examples."""


def write_label_page(
    path: str | os.PathLike, data: JoinedDatasets, labels: EpisodeLabels, examples: Any, check: LabelCheck | None = None
) -> None:
    """
    Write the page of labels.

    :param path: HTML file to write; an older one is replaced
    :param data: the labelled data
    :param labels: their labels
    :param examples: the success examples that the labels were made from
    :param check: comparison with the truth, if it is known
    """
    names = [Path(part.path).name for part in data.parts]
    title = "Success labels of " + html.escape(names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more")
    precision, successes = labels.estimated_precision, labels.estimated_successes
    numbers = {
        "episodes": f"{len(labels.lengths):,}",
        "detected": f"{labels.detected.sum():,}",
        f"of these are successes, by estimate ({precision.low:.0%} to {precision.high:.0%})": f"{precision.value:.0%}",
        f"successes in all, by estimate ({successes.low:,.0f} to {successes.high:,.0f})": f"{successes.value:,.0f}",
    }
    if check is not None:
        numbers["of the detected are successes, by the labels"] = f"{check.precision:.1%}"
        numbers["of the successes are detected, by the labels"] = f"{check.recall:.1%}"
        numbers["AUC, by the labels"] = f"{check.auc:.3f}"
    doubts = [
        section("Warnings", "", f"<ul>{''.join(f'<li>{html.escape(w)}.</li>' for w in labels.warnings)}</ul>", kind="warnings")
    ]
    content = [tiles(numbers), *(doubts if labels.warnings else []), _scores(labels), _sheets(data, labels, examples)]
    content.append(section("Made with", "", details("Settings", dict(labels.made_with))))
    about = "The classifier saw the success examples and the data, and no label of the data."
    write_document(path, title, about, *content)


def _scores(labels: EpisodeLabels) -> str:
    edges = np.histogram_bin_edges(labels.ranking, 60)
    counts = {
        c: np.histogram(labels.ranking[part], edges)[0] for c, part in ((GOOD, labels.detected), (NEUTRAL, ~labels.detected))
    }
    by_score = {ACCENT: np.histogram(labels.scores, np.linspace(0, 1, 41))[0]}
    charts = [
        f"<div><h3>Mean of the three highest logits</h3>{histogram(counts, edges)}</div>",
        f"<div><h3>The same as a probability</h3>{histogram(by_score, np.linspace(0, 1, 41))}</div>",
    ]
    note = (
        "Each episode is scored by its three observations that look most like success. Green episodes are detected. Two hills "
        "with a wide valley between them are easy to tell apart."
    )
    return section("Scores of the episodes", note, f'<div class="grid3">{"".join(charts)}</div>')


def _sheets(data: JoinedDatasets, labels: EpisodeLabels, examples: Any) -> str:
    order = np.argsort(-labels.ranking, kind="stable")
    n = int(labels.detected.sum())
    above, below = order[max(n - SHOWN, 0) : n][::-1], order[n : n + SHOWN]
    parts = {
        "Just above the threshold: these are taken for successes, the most doubtful first": above,
        "Just below the threshold: these are not, the most doubtful first": below,
        "The best": order[: min(SHOWN, n)],
    }
    note = (
        "Of each episode, the observation that looks most like success. Below it are the episode, the observation's index and "
        "the episode's score. If successes are among the frames below the threshold, or failures above it, take another "
        "number of episodes."
    )
    try:
        sheets = [f"<h3>{title}</h3>{_sheet(data, labels, episodes)}" for title, episodes in parts.items() if len(episodes)]
        sheets.insert(0, _example_sheet(data, examples))
    except (RuntimeError, ModuleNotFoundError) as error:
        note += f" There are no frames: the observations hold no images. {html.escape(str(error).splitlines()[0])}"
        sheets = [f"<h3>{title}</h3>{_rows(data, labels, episodes)}" for title, episodes in parts.items() if len(episodes)]
    return section("What they look like", note, *sheets)


def _moment(data: JoinedDatasets, labels: EpisodeLabels, episode: int) -> int:
    """:return: index in its episode of the observation that looks most like success"""
    first = data.step_starts[episode]
    return 1 + int(np.argmax(labels.probabilities[first : first + data.lengths[episode]]))


def _sheet(data: JoinedDatasets, labels: EpisodeLabels, episodes: np.ndarray) -> str:
    name, figures = image_name(data), []
    if name is None and data.env_id != ENV_ID:
        raise RuntimeError("They cannot be drawn.")
    for episode in episodes.tolist():
        moment = _moment(data, labels, episode)
        if name is not None:
            row = int(data.observation_starts[episode]) + moment
            space = subspaces(data.observation_space, "observations")[name]
            frame = to_image(data.arrays[name][row : row + 1][0], space)
        else:
            frame = next(iter(draw_moments(*data.locate(episode), np.array([moment]))))
        caption = f"{episode}, {moment}: {labels.scores[episode]:.2f}"
        figures.append(f'<figure><img src="{png_uri(frame)}" alt="frame"><figcaption>{caption}</figcaption></figure>')
    return f'<div class="sheet">{"".join(figures)}</div>'


def _example_sheet(data: JoinedDatasets, examples: Any) -> str:
    name, observations = image_name(data), load_examples(examples, data.observation_space)
    images = observations.get((name or "").removeprefix("observations/")) if isinstance(observations, dict) else observations
    if name is None or images is None:
        return ""
    space = subspaces(data.observation_space, "observations")[name]
    shown = np.unique(np.linspace(0, len(images) - 1, SHOWN).astype(int))
    figures = [f'<figure><img src="{png_uri(to_image(images[i], space))}" alt="example {i}"></figure>' for i in shown]
    return f'<h3>Success examples</h3><div class="sheet">{"".join(figures)}</div>'


def _rows(data: JoinedDatasets, labels: EpisodeLabels, episodes: np.ndarray) -> str:
    rows = [
        [str(episode), f"{labels.scores[episode]:.3f}", f"{_moment(data, labels, episode)} of {data.lengths[episode]}"]
        for episode in episodes.tolist()
    ]
    return table(["episode", "score", "observation that looks most like success"], rows)
