"""Charts as inline SVG and images as data URIs, so that a page needs no other file and no script."""

import base64
import html
import io
from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image

GOOD, NEUTRAL, ACCENT, EDGE = "#2da44e", "#8c959f", "#0969da", "#d4731c"
PALETTE = ("#0969da", "#d4731c", "#2da44e", "#8250df", "#cf222e", "#1b7c83", "#9a6700", "#bf3989")
_HEAT = np.array([(255, 255, 255), (214, 230, 244), (107, 174, 214), (33, 113, 181), (8, 48, 107)], dtype=np.float64)


def png_uri(image: np.ndarray) -> str:
    """
    :param image: (height, width) or (height, width, 3) uint8
    :return: the image as a data URI
    """
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def histogram(stacks: Mapping[str, np.ndarray], edges: np.ndarray, *, mark_ends: bool = False) -> str:
    """
    :param stacks: (n,) counts by colour, stacked from below in this order
    :param edges: (n + 1,) edges of the bins
    :param mark_ends: draw the first and the last bar in a different colour
    :return: SVG
    """
    width, height, n = 300, 110, len(edges) - 1
    top = max(float(sum(stacks.values()).max()), 1.0)  # type: ignore[union-attr]
    floor, bars = np.zeros(n), []
    for color, counts in stacks.items():
        for index, count in enumerate(counts):
            if count:
                x, y, size = 4 + index * 292 / n, height - 18 - (floor[index] + count) / top * 88, count / top * 88
                fill = EDGE if mark_ends and index in (0, n - 1) else color
                bars.append(f'<rect x="{x:.1f}" y="{y:.1f}" width="{292 / n - 0.6:.1f}" height="{size:.1f}" fill="{fill}"/>')
        floor += counts
    ticks = zip((4, 150, 296), ("start", "middle", "end"), (edges[0], (edges[0] + edges[-1]) / 2, edges[-1]), strict=True)
    labels = "".join(f'<text x="{x}" y="{height - 4}" text-anchor="{anchor}">{value:.3g}</text>' for x, anchor, value in ticks)
    axis = f'<line x1="4" x2="296" y1="{height - 17.5}" y2="{height - 17.5}" class="axis"/>'
    return f'<svg viewBox="0 0 {width} {height}" role="img">{"".join(bars)}{axis}{labels}</svg>'


def curves(series: Mapping[str, np.ndarray], x_label: str) -> str:
    """
    :param series: (n,) shares by label, of equal length; the first curve is bolder
    :param x_label: label of the horizontal axis
    :return: SVG with a legend
    """
    n = len(next(iter(series.values())))
    points = np.unique(np.linspace(0, n - 1, 200).round().astype(int))
    top = next(limit for limit in (0.1, 0.25, 0.5, 1.0) if limit >= max(values.max() for values in series.values()))
    lines, legend = [], []
    for index, (label, values) in enumerate(series.items()):
        color, weight = ("#24292f", 2.5) if index == 0 else (PALETTE[(index - 1) % len(PALETTE)], 1.6)
        steps = [f"{44 + 646 * (p + 1) / n:.1f},{200 - 185 * values[p] / top:.1f}" for p in points]
        lines.append(f'<polyline points="44,200 {" ".join(steps)}" fill="none" stroke="{color}" stroke-width="{weight}"/>')
        legend.append(f'<span><i style="background:{color}"></i>{html.escape(label)}</span>')
    grid = "".join(
        f'<line x1="44" x2="690" y1="{200 - 185 * part}" y2="{200 - 185 * part}" class="grid"/>'
        f'<text x="38" y="{204 - 185 * part}" text-anchor="end">{top * part:.3g}</text>'
        for part in (0, 0.5, 1)
    )
    ticks = "".join(
        f'<text x="{44 + 646 * part}" y="217" text-anchor="{anchor}">{n * part:.4g}</text>'
        for part, anchor in ((0, "middle"), (0.5, "middle"), (1, "end"))
    )
    x_text = f'<text x="367" y="234" text-anchor="middle">{html.escape(x_label)}</text>'
    chart = f'<svg viewBox="0 0 700 240" role="img">{grid}{"".join(lines)}{ticks}{x_text}</svg>'
    return f'<div class="curves">{chart}<p class="legend">{"".join(legend)}</p></div>'


def heat_map(counts: np.ndarray, edges: tuple[np.ndarray, np.ndarray], marks: Mapping[str, tuple[float, float]]) -> str:
    """
    :param counts: (x cells, y cells), drawn on a logarithmic scale
    :param edges: edges of the cells in x and y, evenly spaced
    :param marks: points by label
    :return: SVG, with y upwards
    """
    shades = np.log1p(counts) / max(np.log1p(counts).max(), 1.0)
    stops = np.linspace(0, 1, len(_HEAT))
    colours = np.stack([np.interp(shades, stops, _HEAT[:, channel]) for channel in range(3)], axis=-1)
    image = png_uri(np.round(colours).astype(np.uint8).transpose(1, 0, 2)[::-1])
    (left, right), (bottom, top) = ((edge[0], edge[-1]) for edge in edges)
    width = 300
    height = width * (top - bottom) / (right - left)
    parts = [f'<image href="{image}" x="0" y="0" width="{width}" height="{height:.1f}" preserveAspectRatio="none"/>']
    for label, (x, y) in marks.items():
        u, v = width * (x - left) / (right - left), height * (top - y) / (top - bottom)
        parts.append(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="2.5" class="mark"/>')
        at, anchor = (
            (f'x="{u + 12:.1f}" y="{v - 5:.1f}"', "end") if u > width * 0.75 else (f'x="{u + 5:.1f}" y="{v + 3:.1f}"', "start")
        )
        parts.append(f'<text {at} text-anchor="{anchor}" class="halo">{html.escape(label)}</text>')
    frame = f'<rect x="0.5" y="0.5" width="{width - 1}" height="{height - 1:.1f}" fill="none" class="axis"/>'
    return f'<svg viewBox="0 0 {width} {height:.1f}" class="heat" role="img">{"".join(parts)}{frame}</svg>'


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """
    :param head: titles of the columns, as plain texts
    :param rows: cells as HTML; the first cell of a row is its title
    :return: HTML
    """
    titles = "".join(f"<th>{html.escape(text)}</th>" for text in head)
    body = "".join(f"<tr><th>{first}</th>{''.join(f'<td>{cell}</td>' for cell in rest)}</tr>" for first, *rest in rows)
    return f'<div class="wide"><table><thead><tr>{titles}</tr></thead><tbody>{body}</tbody></table></div>'


def bar(share: float) -> str:
    """:return: HTML of a share, with a bar behind the number"""
    return f'<span class="bar" style="--share:{100 * share:.1f}%">{share:.1%}</span>'
