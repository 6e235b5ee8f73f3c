"""The page of a dataset: one HTML file that refers to no other file."""

import html
import json
import os
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_offline.data.examples import load_examples
from sb3_offline.data.files import replacing
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
from sb3_offline.data_tools.inspecting.summary import format_examples
from sb3_offline.envs import ENV_ID

MOST_EXAMPLES = 40
"""Number of success examples shown."""

STYLE = """
:root { color: #24292f; background: #f6f8fa; font: 15px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1120px; padding: 24px 16px 48px; }
h1 { font-size: 24px; line-height: 1.25; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 18px; margin: 0 0 4px; }
h3 { font-size: 14px; margin: 0 0 4px; font-weight: 600; overflow-wrap: anywhere; }
p { margin: 0 0 10px; }
.note { color: #57606a; font-size: 13px; max-width: 110ch; overflow-wrap: anywhere; }
section { background: #fff; border: 1px solid #d0d7de; border-radius: 8px; padding: 16px; margin-top: 16px; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(130px, 1fr)); gap: 8px; margin-top: 16px; }
.tiles div { background: #fff; border: 1px solid #d0d7de; border-radius: 8px; padding: 10px 14px; }
.tiles b { display: block; font-size: 22px; line-height: 1.3; font-variant-numeric: tabular-nums; }
.tiles span { color: #57606a; font-size: 13px; }
.warnings { border-left: 4px solid #bf8700; }
.sound { border-left: 4px solid #2da44e; }
.warnings ul { margin: 0; padding-left: 20px; }
.warnings li { margin: 4px 0; overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums; width: 100%; }
th, td { padding: 4px 10px; text-align: right; border-top: 1px solid #eaeef2; white-space: nowrap; }
thead th { border-top: 0; color: #57606a; font-weight: 500; vertical-align: bottom; }
th:first-child { text-align: left; padding-left: 0; }
tbody th { font-weight: 500; }
.bar { display: inline-block; min-width: 76px; padding: 0 6px; border-radius: 3px;
  background: linear-gradient(90deg, #aceebb var(--share), #eff2f5 var(--share)); }
.own { outline: 1.5px solid #2da44e; }
.grid4 { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 230px), 1fr)); gap: 18px; }
.grid3 { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 270px), 1fr)); gap: 18px; }
svg { display: block; width: 100%; height: auto; }
svg text { font-size: 11px; fill: #57606a; }
svg .axis { stroke: #8c959f; }
svg .grid { stroke: #eaeef2; }
svg .mark { fill: #d4731c; stroke: #fff; }
svg .halo { fill: #24292f; font-size: 10px; paint-order: stroke; stroke: #fff; stroke-width: 2.5px; }
td svg { width: 130px; margin-left: auto; }
td svg text { display: none; }
.curves { max-width: 760px; }
td small { color: #57606a; display: inline-block; min-width: 44px; }
.heat image, .strip img, .sheet img { image-rendering: pixelated; }
.legend { display: flex; flex-wrap: wrap; gap: 2px 16px; font-size: 13px; color: #57606a; margin: 6px 0 0; }
.legend i { display: inline-block; width: 12px; height: 12px; border-radius: 2px; margin-right: 5px; vertical-align: -1px; }
.strip { display: grid; grid-template-columns: repeat(8, 1fr); gap: 4px; margin: 2px 0 14px; }
.strip figure, .sheet figure { margin: 0; }
.strip img, .sheet img { display: block; width: 100%; border: 2px solid transparent; border-radius: 4px; }
.strip figcaption { font-size: 11px; color: #57606a; text-align: center; }
.strip .good img { border-color: #2da44e; }
.sheet { display: grid; grid-template-columns: repeat(auto-fill, minmax(84px, 1fr)); gap: 4px; margin-top: 10px; }
.sheet .far img { border-color: #cf222e; }
.tag { border-radius: 10px; padding: 0 8px; font-size: 12px; font-weight: 600; background: #eff2f5; }
.tag.good { background: #dafbe1; color: #116329; }
pre { font-size: 12px; white-space: pre-wrap; overflow-wrap: anywhere; margin: 8px 0 0; }
summary { cursor: pointer; color: #0969da; }
@media (max-width: 640px) { body { padding: 16px 10px 32px; } section { padding: 12px; }
  .strip { grid-template-columns: repeat(4, 1fr); } .curves svg text { font-size: 16px; } }
"""


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
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1"><title>{title}</title>'
    environment = html.escape(f"{summary['env_id'] or 'no environment named'} {summary['env_kwargs'] or ''}")
    body = f'<h1>{title}</h1><p class="note">{environment}</p>{_tiles(summary)}{"".join(filter(None, sections))}'
    foot = f'<p class="note" style="margin-top:16px">sb3-offline {metadata.version("sb3-offline")}</p>'
    text = f'<!DOCTYPE html><html lang="en"><head>{head}<style>{STYLE}</style></head><body>{body}{foot}</body></html>'
    with replacing(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _section(title: str, note: str, *content: str, kind: str = "") -> str:
    about = f'<p class="note">{note}</p>' if note else ""
    return f'<section class="{kind}"><h2>{title}</h2>{about}{"".join(content)}</section>'


def _tiles(summary: dict[str, Any]) -> str:
    everything = summary.get("groups", {}).get("all", {})
    tiles = {"episodes": f"{summary['n_episodes']:,}", "steps": f"{summary['n_steps']:,}"}
    if "lengths" in summary:
        low, high = summary["lengths"]["min"], summary["lengths"]["max"]
        tiles["steps an episode"] = f"{low:.0f}" if low == high else f"{low:.0f} to {high:.0f}"
    if "success" in everything:
        tiles["of the episodes solved"] = f"{everything['success']:.1%}"
    if "return" in everything:
        tiles["mean return"] = f"{everything['return']['mean']:.4g}"
    tiles["MB"] = f"{sum(file['bytes'] for file in summary['files']) / 1e6:,.1f}"
    return (
        f'<div class="tiles">{"".join(f"<div><b>{value}</b><span>{name}</span></div>" for name, value in tiles.items())}</div>'
    )


def _warnings(summary: dict[str, Any]) -> str:
    if not summary["warnings"]:
        return _section("No warnings", "", kind="sound")
    items = [
        f"<li><b>{html.escape(w['field'])}</b>: {html.escape(w['problem'])}. <span>{html.escape(w['remedy'])}.</span></li>"
        for w in summary["warnings"]
    ]
    return _section(f"Warnings ({len(items)})", "", f"<ul>{''.join(items)}</ul>", kind="warnings")


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
    return _section("Episodes", " ".join(note), *content)


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
    return _section("Tasks", note, table(["source", *names], rows))


def _actions(data: JoinedDatasets, summary: dict[str, Any]) -> str:
    actions = summary["actions"]
    if not isinstance(data.action_space, spaces.Box):
        total = sum(actions["counts"].values())
        rows = [[html.escape(value), f"{count:,}", bar(count / total)] for value, count in actions["counts"].items()]
        return _section("Actions", "", table(["action", "steps", "share"], rows))
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
    return _section("Actions", note, f'<div class="grid4">{"".join(charts)}</div>')


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
    return _section("Where the gripper goes", note, f'<div class="grid3">{"".join(maps)}</div>')


def _film(data: JoinedDatasets) -> str:
    if image_name(data) is None and data.env_id != ENV_ID:
        return ""
    try:
        strips = film_strips(data)
    except (RuntimeError, ModuleNotFoundError) as error:
        return _section(
            "Film strips", f"There are none: the observations hold no images. {html.escape(str(error).splitlines()[0])}"
        )
    drawn = "" if image_name(data) else " The file holds states; these frames were drawn from its scene_state."
    note = (
        f"Random episodes. A frame is green if the step before it was a success. Below it is the observation's index.{drawn}"
    )
    return _section("Film strips", note, *map(_strip, strips))


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
    content.append(_details("Provenance of the examples", check["provenance"]))
    return _section("Success examples", note, *content)


def _file(summary: dict[str, Any]) -> str:
    rows = []
    for name, array in summary["arrays"].items():
        ends = [f"{array[key]:.5g}" if key in array else "-" for key in ("min", "max")]
        rows.append([html.escape(name), " × ".join(map(str, array["shape"])), array["dtype"], *ends])
    content = [table(["array", "shape", "dtype", "min", "max"], rows)]
    content.append(f'<p class="note" style="margin-top:10px">Observations: {html.escape(summary["observation_space"])}<br>')
    content.append(f"Actions: {html.escape(summary['action_space'])}</p>")
    content += [_details("Files", summary["files"]), _details("Provenance", summary["provenance"])]
    return _section("In the file", "Ranges of images are measured on a sample.", *content)


def _details(title: str, value: Any) -> str:
    return f"<details><summary>{title}</summary><pre>{html.escape(json.dumps(value, indent=2))}</pre></details>"
