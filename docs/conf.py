"""Configuration of the documentation. Build it with: python -m sphinx -W -b html docs docs/_build"""

import inspect
import re
from pathlib import Path
from typing import Any

import sb3_offline
from sb3_offline.common.example_based import ExampleBasedAlgorithm
from sb3_offline.common.reward_based import RewardBasedAlgorithm

project = "sb3-offline"
author = "the sb3-offline authors"
version = release = sb3_offline.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build", "_generated", "results/notes.md"]
html_extra_path = ["pages"]  # made by `sb3-offline inspect --html`
nitpicky = False  # types of SB3, torch and gymnasium are not looked up: the build needs no network

# Formulas in dollars, and an anchor for each heading down to the third level.
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3

# As in SB3, a class is documented by its docstring and the parameters of its constructor.
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"

html_theme = "alabaster"
html_title = f"sb3-offline {version}"
html_theme_options = {
    "description": "Offline and example-based RL for Stable-Baselines3",
    "page_width": "1240px",
    "body_max_width": "950px",
    "sidebar_width": "240px",
    "font_size": "16px",
    "code_font_size": "0.85em",
    "fixed_sidebar": True,
}
html_show_copyright = False

# The table of algorithms on the first page follows from the registry.
DOCS = Path(__file__).parent

#: Base classes and what their subclasses learn from; the first one that fits counts.
SUPERVISION = {
    ExampleBasedAlgorithm: "unlabelled data and success examples",
    RewardBasedAlgorithm: "data with rewards",
    object: "data alone",
}


def algorithm_table() -> str:
    """:return: a Markdown table of all algorithms: page, what they learn from, first sentence of the docstring"""
    rows = []
    for name, algorithm in sb3_offline.ALGOS.items():
        place, supervision = next(
            (place, text) for place, (base, text) in enumerate(SUPERVISION.items()) if issubclass(algorithm, base)
        )
        title = (DOCS / f"algorithms/{name}.md").read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
        paragraph = " ".join((inspect.getdoc(algorithm) or "").partition("\n\n")[0].split()).replace("``", "`")
        sentence = re.sub(r",? ?https?://[^)\s]+", "", re.split(r"(?<!Eq)\. ", paragraph)[0]).replace(" ()", "")
        sentence = sentence.rstrip(":.").replace("|", r"\|")
        rows.append((place, name, f"| [{title}](algorithms/{name}.md) | {supervision} | {sentence} |"))
    return "\n".join(["| Algorithm | learns from | |", "|---|---|---|", *(row for _, _, row in sorted(rows))]) + "\n"


def setup(app: Any) -> None:
    """Called by Sphinx before it reads the pages: index.md includes this file."""
    (DOCS / "_generated").mkdir(exist_ok=True)
    (DOCS / "_generated/algorithms.md").write_text(algorithm_table(), encoding="utf-8")
