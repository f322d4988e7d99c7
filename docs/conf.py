"""How Sphinx builds the site: pages in Markdown (MyST), the reference made from the code, the theme Furo."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

from sphinx.application import Sphinx

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]
os.environ.pop("COMP_LINE", None)  # of a shell that completes; Hydra would answer it

import memmlp  # noqa: E402
import reference  # noqa: E402

project = "memmlp"
author = "The memmlp developers"
copyright = f"2026, {author}"  # noqa: A001
version = release = memmlp.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode",
              "sphinx_copybutton", "sphinx_design"]  # fmt: skip
exclude_patterns = ["results/data", "results/templates"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = "memmlp"
html_static_path = ["site"]
html_css_files = ["site.css"]
html_theme_options = {"source_repository": "https://github.com/memmlp/memmlp/", "source_branch": "main",
                      "source_directory": "docs/"}  # fmt: skip
pygments_dark_style = "monokai"
copybutton_exclude = ".linenos, .gp, .go, .c1"

default_role = "code"  # docstrings write `name` as Markdown does
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
napoleon_use_ivar = True
napoleon_custom_sections = ["Source"]
suppress_warnings = ["config.cache"]


def plain_markup(_app: Sphinx, what: str, *rest: object) -> None:
    """Docstrings are plain words with `names`: what reStructuredText would read into them is taken literally."""
    lines: list[str] = rest[-1]  # type: ignore[assignment]
    lines[:] = literal_blocks(lines) if what == "module" else [escaped(line) for line in lines]


def escaped(line: str) -> str:
    """A line whose stars, bars and trailing underscores outside backticks mean themselves."""
    parts = re.split(r"(`[^`]*`)", line)
    return "".join(
        part if index % 2 else re.sub(r"[*|]|(?<=\w)_(?!\w)", r"\\\g<0>", part)
        for index, part in enumerate(parts)
    )


def literal_blocks(lines: list[str]) -> list[str]:
    """The paragraphs of a module's docstring, examples and tables among them as blocks of code."""
    made: list[str] = []
    for paragraph in "\n".join(lines).split("\n\n"):
        rows = paragraph.strip("\n").split("\n")
        if any(re.search(r"\S {2,}\S|^\s*\|", row) for row in rows):
            made += ["::", "", *(f"   {row}" for row in rows), ""]
        else:
            made += [*map(escaped, rows), ""]
    return made


def folders_as_text(_app: Sphinx, docname: str, source: list[str]) -> None:
    """Links to folders, which GitHub lists and a site has no page for, as their words."""
    source[0] = re.sub(r"\[([^\]]+)\]\((?!\w+:)[^)\s]*/\)", r"\1", source[0])


def setup(app: Sphinx) -> None:
    """Make the reference, then let pages and docstrings pass the functions above."""
    reference.write(HERE / "reference")
    app.connect("source-read", folders_as_text)
    app.connect("autodoc-process-docstring", plain_markup)
