"""The files of the page, either one by one for a browser, or all in one file that needs no server."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any

TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css"}
HERE, PLAYER, SHARED = "memmlp.report.ui", "memmlp.live.session", "memmlp.common"
MODULES = {
    **{name: HERE for name in (
        "main.js", "store.js", "format.js", "charts.js", "runs.js", "run.js", "sweeps.js",
        "searches.js", "compare.js", "replay.js", "filter.js",
    )},
    **{name: PLAYER for name in (
        "stage.js", "three/three.module.min.js", "three/three.core.min.js", "three/OrbitControls.js",
    )},
    "dom.js": SHARED,
}  # fmt: skip
SCRIPTS = ("theme.js", "plot/d3.min.js", "plot/plot.umd.min.js")
FILES = {
    "index.html": HERE,
    "style.css": SHARED,
    **dict.fromkeys(SCRIPTS, HERE),
    "theme.js": SHARED,
    **MODULES,
}
"""All files of the page, with the package that contains each; no other file is ever sent."""


@cache
def read(name: str) -> bytes:
    """Return a file of the page. Raises KeyError for an unknown name."""
    return resources.files(FILES[name]).joinpath("page", *name.split("/")).read_bytes()


def content_type(name: str) -> str:
    """Return the content type of a file."""
    return f"{TYPES[name.rsplit('.', 1)[-1]]}; charset=utf-8"


def policy() -> str:
    """Return the Content-Security-Policy: only scripts of this page, and its import map."""
    inline = re.search(r'<script type="importmap">(.*?)</script>', read("index.html").decode(), re.DOTALL)
    assert inline is not None
    digest = base64.b64encode(hashlib.sha256(inline[1].encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'self' 'sha256-{digest}'; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' data:; connect-src 'self'; base-uri 'none'; "
        "form-action 'none'; frame-ancestors 'none'"
    )


def one_file(answers: Mapping[str, Any], extra: str = "") -> str:
    """Return the page as one file.

    Args:
        answers: the server's answers, by address.
        extra: HTML of a further page, "Tables and figures"; empty for none.
    """
    page = read("index.html").decode()
    style = f"<style>{read('style.css').decode()}</style>"
    scripts = "".join(f"<script>{_closed(read(name).decode())}</script>" for name in SCRIPTS)
    imports = json.dumps({"imports": {_bare(name): _address(name) for name in MODULES if name != "main.js"}})
    main = f'<script type="module">{_closed(_module("main.js"))}</script>'
    data = json.dumps(answers, separators=(",", ":")).replace("<", "\\u003c")
    parts = {
        r'<link rel="stylesheet" href="style.css">': style,
        r'<script src="theme.js"></script>': scripts,
        r'<script src="plot/d3.min.js"></script>': "",
        r'<script src="plot/plot.umd.min.js"></script>': "",
        r'<script type="importmap">.*?</script>': f'<script type="importmap">{imports}</script>',
        r'<script type="module" src="main.js"></script>': (
            f'<script type="application/json" id="answers">{data}</script>'
            f'<template id="extra">{extra}</template>{main}'
        ),
    }  # fmt: skip
    for old, new in parts.items():
        page = _put(page, old, new)
    return page


def _put(page: str, old: str, new: str) -> str:
    """Return a page in which the only match of a pattern is replaced by a text."""
    page, count = re.subn(old, lambda _: new, page, flags=re.DOTALL)
    assert count == 1, old
    return page


def _bare(name: str) -> str:
    """Return the name by which modules of the one-file page import a module."""
    return "three" if name.endswith("three.module.min.js") else f"memmlp/{name}"


def _module(name: str) -> str:
    """Return a module's text with names in place of relative addresses, which data: addresses can't have."""
    text = read(name).decode()
    return re.sub(
        r"""(from\s*|import\s*\(?\s*)(["'])\.{1,2}/([\w./]+)\2""",
        lambda found: f"{found[1]}{found[2]}memmlp/{_full(name, found[3])}{found[2]}",
        text,
    )


def _full(importer: str, name: str) -> str:
    """Return the full name of a module that another module imports by a relative address."""
    return next(one for one in (f"{importer.rpartition('/')[0]}/{name}".lstrip("/"), name) if one in MODULES)


def _address(name: str) -> str:
    return f"data:text/javascript;base64,{base64.b64encode(_module(name).encode()).decode()}"


def _closed(script: str) -> str:
    """Return a script in a form that may be put inside HTML."""
    return script.replace("</script", "<\\/script")
