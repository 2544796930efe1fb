"""Sphinx: the pages of this folder as a site, with a reference of the public names. ``python -m sphinx -W docs site``."""

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "src"))

import softmpm

project = "softmpm"
author = copyright = "the softmpm maintainers"
release = softmpm.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["results"]
myst_heading_anchors = 4
html_theme = "furo"
html_title = f"softmpm {release}"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_class_signature = "mixed"
napoleon_numpy_docstring = False


fields: dict[str, list[str]] = {}


def escape(app, what, name, obj, options, lines):
    """Shapes such as (world, *nodes) and norms such as |x| have no markup in docstrings."""
    lines[:] = [re.sub(r"(?<!\\)(\*(?=nodes)|\|)", r"\\\1", line) for line in lines]
    fields[name] = list(lines)


def restore(app, what, name, obj, options, lines):
    """Napoleon takes what stands before a colon in the docstring of a field for its type."""
    if what == "attribute":
        lines[:] = fields[name]


def setup(app):
    app.connect("autodoc-process-docstring", escape, priority=400)  # before napoleon
    app.connect("autodoc-process-docstring", restore, priority=600)  # after it
