"""The parts that all pages have: the document with its style, tiles of numbers, sections."""

import html
import json
import os
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from sb3_offline.data.files import replacing

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
.sheet figcaption { font-size: 11px; color: #57606a; text-align: center; }
.tag { border-radius: 10px; padding: 0 8px; font-size: 12px; font-weight: 600; background: #eff2f5; }
.tag.good { background: #dafbe1; color: #116329; }
pre { font-size: 12px; white-space: pre-wrap; overflow-wrap: anywhere; margin: 8px 0 0; }
summary { cursor: pointer; color: #0969da; }
@media (max-width: 640px) { body { padding: 16px 10px 32px; } section { padding: 12px; }
  .strip { grid-template-columns: repeat(4, 1fr); } .curves svg text { font-size: 16px; } }
"""


def write_document(path: str | os.PathLike, title: str, about: str, *content: str) -> None:
    """
    Write a page that refers to no other file.

    :param path: HTML file to write; an older one is replaced
    :param title: its title, as HTML
    :param about: the line below the title, as HTML
    :param content: HTML
    """
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1"><title>{title}</title>'
    body = f'<h1>{title}</h1><p class="note">{about}</p>{"".join(content)}'
    foot = f'<p class="note" style="margin-top:16px">sb3-offline {metadata.version("sb3-offline")}</p>'
    text = f'<!DOCTYPE html><html lang="en"><head>{head}<style>{STYLE}</style></head><body>{body}{foot}</body></html>'
    with replacing(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8")


def tiles(numbers: Mapping[str, str]) -> str:
    """
    :param numbers: values by what they count
    :return: HTML, the values in large type
    """
    figures = (f"<div><b>{value}</b><span>{name}</span></div>" for name, value in numbers.items())
    return f'<div class="tiles">{"".join(figures)}</div>'


def section(title: str, note: str, *content: str, kind: str = "") -> str:
    """
    :param title: title of the section, as HTML
    :param note: explanation below it, as HTML
    :param content: HTML
    :param kind: class of its style: "warnings", "sound" or none
    :return: HTML
    """
    about = f'<p class="note">{note}</p>' if note else ""
    return f'<section class="{kind}"><h2>{title}</h2>{about}{"".join(content)}</section>'


def details(title: str, value: Any) -> str:
    """
    :param title: what is shown before a click
    :param value: in JSON types
    :return: HTML
    """
    return f"<details><summary>{title}</summary><pre>{html.escape(json.dumps(value, indent=2))}</pre></details>"
