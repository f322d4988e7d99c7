"""The files of the page: separate for a server, or combined in one file that needs no server."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from memmlp.common.page_server import read_page_file

UI_PACKAGE, LIVE_PACKAGE, COMMON_PACKAGE = "memmlp.report.ui", "memmlp.live.session", "memmlp.common"
SCRIPTS = {"plot/d3.min.js": UI_PACKAGE, "plot/plot.umd.min.js": UI_PACKAGE}
MODULES = {
    **dict.fromkeys(
        ("main.js", "store.js", "filter.js", "format.js", "charts.js", "runs.js", "run.js", "sweeps.js",
         "searches.js", "curves.js", "replay.js"),
        UI_PACKAGE,
    ),
    **dict.fromkeys(
        ("stage.js", "viewer.js", "three/three.module.min.js", "three/three.core.min.js",
         "three/OrbitControls.js"),
        LIVE_PACKAGE,
    ),
    "dom.js": COMMON_PACKAGE,
}  # fmt: skip
FILES = {"index.html": UI_PACKAGE, "style.css": COMMON_PACKAGE, **SCRIPTS, **MODULES}
"""The files of the page by name, with their packages. The server sends no other files."""


@cache
def read_file(name: str) -> bytes:
    """Read a file of the page. Raises KeyError for an unknown name."""
    return read_page_file(FILES[name], name)


def make_single_file(answers: Mapping[str, Any]) -> str:
    """Return the page as one file.

    Args:
        answers: the server's answers by path.
    """
    addresses = {
        "three" if name.endswith("three.module.min.js") else f"memmlp/{name}": (
            f"data:text/javascript;base64,{base64.b64encode(_use_bare_imports(name).encode()).decode()}"
        )
        for name in MODULES
    }
    data = json.dumps(answers, separators=(",", ":")).replace("<", "\\u003c")
    head = (
        f"<style>{read_file('style.css').decode()}</style>"
        + "".join(f"<script>{_escape_script_end(read_file(name).decode())}</script>" for name in SCRIPTS)
        + f'<script type="importmap">{json.dumps({"imports": addresses})}</script>'
        + f'<script type="application/json" id="answers">{data}</script>'
        + f'<script type="module">{_escape_script_end(_use_bare_imports("main.js"))}</script>'
    )
    loading = r'<link rel="stylesheet".*<script type="module" src="main.js"></script>'
    page, count = re.subn(loading, lambda _: head, read_file("index.html").decode(), flags=re.DOTALL)
    assert count == 1
    return page


def _use_bare_imports(importer: str) -> str:
    """Return a module's text with bare names in imports, because data: URLs can't have relative imports."""

    def make_bare_import(match: re.Match[str]) -> str:
        sibling = f"{importer.rpartition('/')[0]}/{match[3]}".lstrip("/")
        return f"{match[1]}{match[2]}memmlp/{sibling if sibling in MODULES else match[3]}{match[2]}"

    return re.sub(
        r"""(from\s*|import\s*\(?\s*)(["'])\.{1,2}/([\w./]+)\2""",
        make_bare_import,
        read_file(importer).decode(),
    )


def _escape_script_end(script: str) -> str:
    return script.replace("</script", "<\\/script")
