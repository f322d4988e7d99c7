"""The files of the page, either one by one for a browser, or all in one file that needs no server."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from memmlp.common.page_server import read_page_file

OWN, LIVE, SHARED = "memmlp.report.ui", "memmlp.live.session", "memmlp.common"
SCRIPTS = {"plot/d3.min.js": OWN, "plot/plot.umd.min.js": OWN}
MODULES = {
    **dict.fromkeys(
        ("main.js", "store.js", "filter.js", "format.js", "charts.js", "runs.js", "run.js", "sweeps.js",
         "searches.js", "compare.js", "replay.js"),
        OWN,
    ),
    **dict.fromkeys(
        ("stage.js", "three/three.module.min.js", "three/three.core.min.js", "three/OrbitControls.js"), LIVE
    ),
    "dom.js": SHARED,
}  # fmt: skip
FILES = {"index.html": OWN, "style.css": SHARED, **SCRIPTS, **MODULES}
"""All files of the page, with the package that contains each; no other file is ever sent."""


@cache
def read(name: str) -> bytes:
    """Return a file of the page. Raises KeyError for an unknown name."""
    return read_page_file(FILES[name], name)


def one_file(answers: Mapping[str, Any]) -> str:
    """Return the page as one file.

    Args:
        answers: the server's answers, by address.
    """
    addresses = {
        "three" if name.endswith("three.module.min.js") else f"memmlp/{name}": (
            f"data:text/javascript;base64,{base64.b64encode(_with_bare_imports(name).encode()).decode()}"
        )
        for name in MODULES
    }
    data = json.dumps(answers, separators=(",", ":")).replace("<", "\\u003c")
    head = (
        f"<style>{read('style.css').decode()}</style>"
        + "".join(f"<script>{_escape_end(read(name).decode())}</script>" for name in SCRIPTS)
        + f'<script type="importmap">{json.dumps({"imports": addresses})}</script>'
        + f'<script type="application/json" id="answers">{data}</script>'
        + f'<script type="module">{_escape_end(_with_bare_imports("main.js"))}</script>'
    )
    loading = r'<link rel="stylesheet".*<script type="module" src="main.js"></script>'
    page, count = re.subn(loading, lambda _: head, read("index.html").decode(), flags=re.DOTALL)
    assert count == 1
    return page


def _with_bare_imports(importer: str) -> str:
    """Return a module's text with names in place of relative addresses, which data: addresses can't have."""

    def name_of(found: re.Match[str]) -> str:
        beside = f"{importer.rpartition('/')[0]}/{found[3]}".lstrip("/")
        return f"{found[1]}{found[2]}memmlp/{beside if beside in MODULES else found[3]}{found[2]}"

    return re.sub(r"""(from\s*|import\s*\(?\s*)(["'])\.{1,2}/([\w./]+)\2""", name_of, read(importer).decode())


def _escape_end(script: str) -> str:
    return script.replace("</script", "<\\/script")
