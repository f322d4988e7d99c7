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

import reference  # noqa: E402

import memmlp  # noqa: E402

project = "memmlp"
author = "The memmlp developers"
copyright = f"2026, {author}"
version = release = memmlp.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.linkcode",
              "sphinx_copybutton", "sphinx_design"]  # fmt: skip
exclude_patterns = ["results/templates", "examples"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = "memmlp"
html_static_path = ["site"]
html_css_files = ["site.css"]
html_theme_options = {"source_repository": "https://github.com/memmlp/memmlp/", "source_branch": "main",
                      "source_directory": "docs/"}  # fmt: skip
highlight_language = "text"  # where a block names none
pygments_dark_style = "monokai"
copybutton_exclude = ".linenos, .gp, .go, .c1"

default_role = "code"  # docstrings write `name` as Markdown does
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_type_aliases = {name: name for name in ("ArrayLike", "RunLogger", "State", "Terms")}
napoleon_use_ivar = True
napoleon_custom_sections = ["Source"]
suppress_warnings = ["ref.python"]  # attributes' names are no references


COLON = "\N{TWO DOT PUNCTUATION}"  # a colon that napoleon does not see


def plain_markup(_app: Sphinx, what: str, *rest: object) -> None:
    """Take docstrings as plain words with `names`, whatever reStructuredText would read into them."""
    lines: list[str] = rest[-1]  # type: ignore[assignment]
    lines[:] = literal_blocks(lines) if what == "module" else [escaped(line) for line in lines]
    for index, line in enumerate(lines):  # "a, b: words" under Args is one field of two names
        lines[index] = re.sub(r"^ {4}(\w+(?:, \w+)+):", lambda found: found[0].replace(", ", ","), line)
    if what in ("attribute", "data") and lines:  # a colon in its words would end a type
        lines[0] = lines[0].replace(":", COLON)


def colons(_app: Sphinx, what: str, *rest: object) -> None:
    """Undo what hid colons."""
    lines: list[str] = rest[-1]  # type: ignore[assignment]
    lines[:] = [line.replace(COLON, ":") for line in lines]


def escaped(line: str) -> str:
    """A line whose stars, bars, trailing underscores and options outside backticks mean themselves."""
    parts = re.split(r"(`[^`]*`)", line)
    for index in range(0, len(parts), 2):
        marked = re.sub(r"[*|]|(?<=\w)_(?!\w)", r"\\\g<0>", parts[index])
        parts[index] = re.sub(r"(?<![\w-])--[a-z][\w-]*", r"`\g<0>`", marked)  # an option, and no dash
    return "".join(parts)


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


def named_fields(
    _app: Sphinx, what: str, name: str, thing: object, skip: bool, _options: object
) -> bool | None:
    """Leave out the fields of named tuples, which their class describes."""
    return True if type(thing).__name__ == "_tuplegetter" else None


def linkcode_resolve(domain: str, info: dict[str, str]) -> str | None:
    """Return the address of a module's source code. Pages with copies of all modules take long to build."""
    path = HERE.parent / info["module"].replace(".", "/")
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return f"https://github.com/memmlp/memmlp/blob/main/{file.relative_to(HERE.parent)}"


def setup(app: Sphinx) -> None:
    """Make the reference, then let pages and docstrings pass the functions above."""
    reference.write(HERE / "reference")
    app.connect("source-read", folders_as_text)
    app.connect("autodoc-skip-member", named_fields)
    app.connect("autodoc-process-docstring", plain_markup, priority=400)  # napoleon's is 500
    app.connect("autodoc-process-docstring", colons, priority=600)
