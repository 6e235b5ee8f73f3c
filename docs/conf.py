"""Configuration of the documentation. Build it with: python -m sphinx -W -b html docs docs/_build"""

import sb3_offline

project = "sb3-offline"
author = "the sb3-offline authors"
version = release = sb3_offline.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build", "results/notes.md"]
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
    "page_width": "1100px",
    "sidebar_width": "240px",
    "fixed_sidebar": True,
}
html_show_copyright = False
