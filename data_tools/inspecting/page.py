"""The page of a dataset: one HTML file that refers to no other file."""

import html
import os
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_offline.data.examples import load_examples
from sb3_offline.data.spaces import subspaces
from sb3_offline.data_tools.inspecting.dataset_statistics import action_histograms, episode_returns, solved_by, table_coverage
from sb3_offline.data_tools.inspecting.joined_datasets import JoinedDatasets
from sb3_offline.data_tools.inspecting.page_charts import (
    ACCENT,
    GOOD,
    NEUTRAL,
    bar,
    curves,
    heat_map,
    histogram,
    png_uri,
    table,
)
from sb3_offline.data_tools.inspecting.page_images import MOST_SOURCES, FilmStrip, film_strips, image_name, to_image
from sb3_offline.data_tools.inspecting.page_parts import details, section, tiles, write_document
from sb3_offline.data_tools.inspecting.summary import format_examples
from sb3_offline.envs import ENV_ID

MOST_EXAMPLES = 40
"""Number of success examples shown."""


def write_page(
    path: str | os.PathLike,
    data: JoinedDatasets,
    summary: dict[str, Any],
    examples: str | os.PathLike | np.ndarray | None = None,
) -> None:
    """
    Write the page of a dataset.

    :param path: HTML file to write; an older one is replaced
    :param data: the dataset
    :param summary: its summary, from ``inspect_dataset``
    :param examples: the success examples that the summary was made with, if any
    """
    files = [Path(file["file"]).name for file in summary["files"]]
    title = html.escape(files[0] if len(files) == 1 else f"{files[0]} and {len(files) - 1} more")
    sections = [_warnings(summary)]
    if data.n_episodes:
        sections += [_episodes(data, summary), _tasks(data, summary), _actions(data, summary), _coverage(data)]
        sections += [_film(data), _examples(data, summary, examples)]
    sections.append(_file(summary))
    environment = html.escape(f"{summary['env_id'] or 'no environment named'} {summary['env_kwargs'] or ''}")
    write_document(path, title, environment, tiles(_counts(summary)), *filter(None, sections))


def _counts(summary: dict[str, Any]) -> dict[str, str]:
    everything = summary.get("groups", {}).get("all", {})
    counts = {"episodes": f"{summary['n_episodes']:,}", "steps": f"{summary['n_steps']:,}"}
    if "lengths" in summary:
        low, high = summary["lengths"]["min"], summary["lengths"]["max"]
        counts["steps an episode"] = f"{low:.0f}" if low == high else f"{low:.0f} to {high:.0f}"
    if "success" in everything:
        counts["of the episodes solved"] = f"{everything['success']:.1%}"
    if "return" in everything:
        counts["mean return"] = f"{everything['return']['mean']:.4g}"
    return {**counts, "MB": f"{sum(file['bytes'] for file in summary['files']) / 1e6:,.1f}"}


def _warnings(summary: dict[str, Any]) -> str:
    if not summary["warnings"]:
        return section("No warnings", "", kind="sound")
    items = [
        f"<li><b>{html.escape(w['field'])}</b>: {html.escape(w['problem'])}. <span>{html.escape(w['remedy'])}.</span></li>"
        for w in summary["warnings"]
    ]
    return section(f"Warnings ({len(items)})", "", f"<ul>{''.join(items)}</ul>", kind="warnings")


def _episodes(data: JoinedDatasets, summary: dict[str, Any]) -> str:
    returns, solved, members = episode_returns(data), data.solved(), data.groups()
    head, note = ["source", "episodes", "steps"], []
    if solved is not None:
        head += ["solved", "solved at end"]
        note.append("Solved: success at any step. Solved at end: success after the last step.")
    if returns is not None:
        head += ["mean return", "min", "max", "returns"]
        note.append("Returns: all episodes of the source" + ("." if solved is None else "; green bars are solved ones."))
        if data.rewards is None:
            note.append("The file has no rewards: returns are sums of the stock rewards of each episode's own task.")
        edges = np.histogram_bin_edges(returns, 30)
    rows = []
    for label, group in summary["groups"].items():
        row, inside = [html.escape(label), f"{group['episodes']:,}", f"{group['steps']:,}"], members[label]
        if solved is not None:
            row += [bar(group[name]) if name in group else "-" for name in ("success", "success_at_end")]
        if returns is not None:
            row += [f"{group['return'][name]:.5g}" if "return" in group else "-" for name in ("mean", "min", "max")]
            parts = {ACCENT: inside} if solved is None else {GOOD: inside & solved, NEUTRAL: inside & ~solved}
            row.append(histogram({color: np.histogram(returns[part], edges)[0] for color, part in parts.items()}, edges))
        rows.append(row)
    content = [table(head, rows)]
    shares = solved_by(data)
    if shares:
        labels = sorted(shares, key=lambda label: (label != "all", -members[label].sum()))[: MOST_SOURCES + 1]
        chart = curves({label: shares[label] for label in labels}, "steps")
        content.append(f'<h3 style="margin-top:18px">Share of the episodes that are solved by each step</h3>{chart}')
    return section("Episodes", " ".join(note), *content)


def _tasks(data: JoinedDatasets, summary: dict[str, Any]) -> str:
    if not summary["tasks"]:
        return ""
    names = list(next(iter(summary["tasks"].values())))
    rows = []
    for label, row in summary["tasks"].items():
        shares = [f'<span class="{"own" if task == label else ""}">{bar(row[task]["success"])}</span>' for task in names]
        cells = [f"{share} <small>{row[task]['return']:.4g}</small>" for share, task in zip(shares, names, strict=True)]
        rows.append([html.escape(label), *cells])
    note = "Share of the episodes that solved each task, attempted or not, and the mean return of its stock reward."
    return section("Tasks", note, table(["source", *names], rows))


def _actions(data: JoinedDatasets, summary: dict[str, Any]) -> str:
    actions = summary["actions"]
    if not isinstance(data.action_space, spaces.Box):
        total = sum(actions["counts"].values())
        rows = [[html.escape(value), f"{count:,}", bar(count / total)] for value, count in actions["counts"].items()]
        return section("Actions", "", table(["action", "steps", "share"], rows))
    charts = []
    for index, (counts, edges) in enumerate(action_histograms(data)):
        low, mean, high, std, saturated = (actions[name][index] for name in ("min", "mean", "max", "std", "saturated"))
        about = f"mean {mean:.3g}, std {std:.3g}, {low:.3g} to {high:.3g}, saturated {saturated:.1%}"
        chart = histogram({ACCENT: counts}, edges, mark_ends=True)
        charts.append(f'<div><h3>action {index}</h3><p class="note">{about}</p>{chart}</div>')
    note = (
        "Histograms between the bounds of the action space; the bars at the bounds are orange. Saturated: within 1 % of a "
        "bound, or beyond it."
    )
    return section("Actions", note, f'<div class="grid4">{"".join(charts)}</div>')


def _coverage(data: JoinedDatasets) -> str:
    coverage = table_coverage(data)
    if coverage is None:
        return ""
    maps = [
        f"<div><h3>{html.escape(label)}</h3>{heat_map(counts, coverage.edges, coverage.bodies)}</div>"
        for label, counts in list(coverage.counts.items())[: MOST_SOURCES + 1]
    ]
    (left, right), (low, high) = ((edge[0], edge[-1]) for edge in coverage.edges)
    note = (
        f"Seen from above: {coverage.what}. x runs to the right from {left:.2f} to {right:.2f} m, y upwards from {low:.2f} to "
    )
    note += f"{high:.2f} m, in cells of 2 cm. Darker cells are visited more often (logarithmic). Dots are the objects."
    return section("Where the gripper goes", note, f'<div class="grid3">{"".join(maps)}</div>')


def _film(data: JoinedDatasets) -> str:
    if image_name(data) is None and data.env_id != ENV_ID:
        return ""
    try:
        strips = film_strips(data)
    except (RuntimeError, ModuleNotFoundError) as error:
        return section(
            "Film strips", f"There are none: the observations hold no images. {html.escape(str(error).splitlines()[0])}"
        )
    drawn = "" if image_name(data) else " The file holds states; these frames were drawn from its scene_state."
    note = (
        f"Random episodes. A frame is green if the step before it was a success. Below it is the observation's index.{drawn}"
    )
    return section("Film strips", note, *map(_strip, strips))


def _strip(strip: FilmStrip) -> str:
    outcome = {None: "", True: '<span class="tag good">solved</span>', False: '<span class="tag">not solved</span>'}[
        strip.solved
    ]
    figures = "".join(
        f'<figure class="{"good" if success else ""}"><img src="{png_uri(frame)}" alt="frame">'
        f"<figcaption>{moment}</figcaption></figure>"
        for frame, moment, success in zip(strip.frames, strip.moments, strip.success, strict=True)
    )
    return f'<h3>{html.escape(strip.source)} {outcome} episode {strip.episode}</h3><div class="strip">{figures}</div>'


def _examples(data: JoinedDatasets, summary: dict[str, Any], examples: Any) -> str:
    if "examples" not in summary:
        return ""
    check = summary["examples"]
    distances, usual = (np.array(check[name]) for name in ("distances", "usual_distances"))
    edges = np.linspace(0, max(distances.max(), usual.max(initial=1e-9)), 41)
    held_out = check["provenance"].get("held_out")
    origin = "" if held_out is None else f"; recorded as {'' if held_out else 'not '}held out from the data"
    note = html.escape(f"{check['examples']}: {format_examples(check)}{origin}.")
    charts = [
        f"<div><h3>{title}</h3>{histogram({color: np.histogram(values, edges)[0]}, edges)}</div>"
        for title, color, values in (("Examples", ACCENT, distances), ("The data, to other episodes", NEUTRAL, usual))
    ]
    lead = '<p class="note">Distance to the nearest observation of the data, in standard deviations:</p>'
    content = [lead, f'<div class="grid3">{"".join(charts)}</div>']
    name = image_name(data)
    images = None
    if name is not None:
        observations = load_examples(examples, data.observation_space)
        key = name.removeprefix("observations/")
        images = observations.get(key) if isinstance(observations, dict) else observations  # examples may lack a key
    if name is not None and images is not None:
        far = check["far"][: MOST_EXAMPLES // 2]
        shown = np.unique(np.linspace(0, len(images) - 1, MOST_EXAMPLES - len(far)).astype(int))
        space = subspaces(data.observation_space, "observations")[name]
        figures = "".join(
            f'<figure class="{"far" if index in check["far"] else ""}">'
            f'<img src="{png_uri(to_image(images[index], space))}" alt="example {index}"></figure>'
            for index in dict.fromkeys([*far, *shown.tolist()])
        )
        content.append(f'<div class="sheet">{figures}</div>')
        if far:
            content.append('<p class="note">Red examples are unlike every observation of the data.</p>')
    content.append(details("Provenance of the examples", check["provenance"]))
    return section("Success examples", note, *content)


def _file(summary: dict[str, Any]) -> str:
    rows = []
    for name, array in summary["arrays"].items():
        ends = [f"{array[key]:.5g}" if key in array else "-" for key in ("min", "max")]
        rows.append([html.escape(name), " × ".join(map(str, array["shape"])), array["dtype"], *ends])
    content = [table(["array", "shape", "dtype", "min", "max"], rows)]
    content.append(f'<p class="note" style="margin-top:10px">Observations: {html.escape(summary["observation_space"])}<br>')
    content.append(f"Actions: {html.escape(summary['action_space'])}</p>")
    content += [details("Files", summary["files"]), details("Provenance", summary["provenance"])]
    return section("In the file", "Ranges of images are measured on a sample.", *content)
