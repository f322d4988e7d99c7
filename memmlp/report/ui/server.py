"""The page's server. It sends files and JSON answers, and makes the changes of runs that the page asks for.

A change needs the page's own token, which only the page can read, and the page's origin. Each is logged in
the run's folder. There are no changes if the outputs folder is read-only."""

from __future__ import annotations

import base64
import contextlib
import json
import math
import os
import re
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, TypedDict

from memmlp.common.errors import InputError
from memmlp.common.files import digest, make_json_safe, read_json, write_json
from memmlp.common.page_server import (
    HOST,
    TEXT,
    PageHandler,
    PageServer,
    build_security_policy,
    find_content_type,
    read_page_file,
)
from memmlp.common.schema import check_type
from memmlp.report.ui import runs
from memmlp.report.ui.replay import Predict, Replays, describe_body
from memmlp.report.ui.run_index import RunIndex
from memmlp.report.ui.searches import Searches
from memmlp.report.ui.sweeps import Sweeps
from memmlp.runs.garbage_runs import delete_run, list_dependents
from memmlp.runs.identity import ID
from memmlp.runs.lookup import change_run
from memmlp.runs.run import Run
from memmlp.sweep.definition import MODES

VIEWS = "views.json"  # the saved views in the outputs folder
FUTURE = ("stop", "prioritize", "unprioritize")  # changes of runs that a sweep has not begun
READ_SECONDS = 0.8  # for new runs before an answer
MAX_PAUSE = 10.0  # seconds between two scans
MAX_CURVES = 60  # maximum number of runs in an answer with curves


class Change(TypedDict, total=False):
    """A change that the page asks for (`Answers.change`)."""

    action: str
    value: str
    name: str
    runs: list[str]


class Answers:
    """Answers the page's requests about an outputs folder.

    Args:
        outputs: the folder of runs and caches.
        predict: computes a run's prediction for a test clip.
        pause: minimum time between two scans of the folder, seconds.
        make_command: returns the command that makes a run again.
    """

    def __init__(
        self,
        outputs: Path,
        predict: Predict,
        pause: float = 1.0,
        make_command: Callable[[Run], str] = lambda run: "",
    ):
        self.outputs, self.pause, self.make_command = outputs, pause, make_command
        self.index = RunIndex(outputs)
        self.sweeps, self.searches = Sweeps(self.index), Searches(outputs)
        self.replays, self.rows = Replays(outputs, predict), runs.Rows(self.index)
        self.lock = threading.Lock()
        self.state, self.next_look = "", 0.0
        self.places: runs.Places = {}

    def refresh(self, seconds: float = math.inf) -> str:
        """Scan the folder, and return a text that changes when any run, sweep or search changes.

        Scans take at most a fifteenth of a core, however many pages are open. New runs are read for some
        `seconds`; the next call reads the others.
        """
        with self.lock:
            started = time.thread_time()
            if time.monotonic() >= self.next_look or (self.index.unread and seconds == math.inf):
                stamps = self.index.refresh(seconds), self.sweeps.refresh(), self.searches.make_change_stamp()
                self.places = self.list_places()
                self.state = f"{self.rows.update(self.places)}-{digest(stamps[1:])[:8]}"
                pause = min(max(self.pause, 15 * (time.thread_time() - started)), MAX_PAUSE)
                self.next_look = 0.0 if self.index.unread else time.monotonic() + pause
            return self.state

    def list_places(self) -> dict[str, list[dict[str, Any]]]:
        """Return the sweeps and searches by run id."""
        places: dict[str, list[dict[str, Any]]] = {}
        for name, sweep in self.sweeps.known.items():
            for entry in sweep.plan.entries:
                place = {"sweep": name, "variant": entry.label, "seed": entry.seed}
                places.setdefault(entry.id, []).append(place)
        for search, number, run_id in self.searches.list_runs():
            places.setdefault(run_id, []).append({"search": search, "trial": number})
        return places

    def answer(self, path: str, query: Mapping[str, str]) -> Mapping[str, Any]:
        """Return the answer to a request with a path such as "run/0123456789abcdef".

        Raises:
            KeyError: if the path is unknown.
            ValueError: if the query has an invalid value.
        """
        kind, _, name = path.partition("/")
        state = self.refresh(READ_SECONDS if kind == "runs" else math.inf)
        match kind, bool(name):
            case "runs", False:
                if query.get("state") == state:
                    return {"state": state}
                with self.lock:
                    rows = self.rows.list_since(query.get("state", ""), self.places)
                outputs = str(self.outputs.absolute())
                return {**rows, "state": state, "outputs": outputs, "writable": self.is_writable}
            case "curves", False:
                run_ids = [one for one in ID.findall(query.get("runs", "")) if one in self.index.runs]
                found_runs = [Run.from_id(self.outputs, run_id) for run_id in run_ids[:MAX_CURVES]]
                return {"curves": {run.id: runs.read_curves(run) for run in found_runs}}
            case "body", False:
                return describe_body()
            case "views", False:
                return {"views": read_json(self.outputs / VIEWS)}
            case "dependents", True if ID.fullmatch(name):
                return {"lines": list_dependents(self.outputs, Run.from_id(self.outputs, name))}
            case "command", True if name in self.index.runs:
                return {"command": self.make_command(Run.from_id(self.outputs, name))}
            case "sweeps", _:
                return self.sweeps.describe(name) if name else self.sweeps.list_rows()
            case "searches", _:
                return self.searches.describe(name) if name else self.searches.list_rows()
            case (("run" | "replay"), True) if ID.fullmatch(name) and name in self.index.runs:
                if kind == "replay":
                    return self._get_replay(name, query)
                return runs.describe_run(self.index, name, self.sweeps.find_control(name), self.places)
        raise KeyError(path)

    @property
    def is_writable(self) -> bool:
        """Whether runs can be changed."""
        return os.access(self.outputs, os.W_OK)

    def change(self, request: Mapping[str, Any]) -> None:
        """Change runs or saved views. Raises InputError for a bad request.

        Args:
            request: `action`, `value`, and the `runs` by id. The actions are those of `change_run`, "delete",
                and "view", which saves `value`, an address, by its `name`; an empty value deletes the view.
        """
        try:
            check_type(request, Change)
        except ValueError as error:
            raise InputError(f"change: {error}") from None
        action, value, name = (request.get(key, "") for key in ("action", "value", "name"))
        self.refresh()
        if not self.is_writable:
            raise InputError(f"{self.outputs}: must be writable; it is read-only")
        if action == "view":
            if not name.strip():
                raise InputError("name: must not be empty")
            views = read_json(self.outputs / VIEWS) | {name: value}
            write_json(self.outputs / VIEWS, {key: address for key, address in views.items() if address})
            return
        planned = {task.id for known in self.sweeps.known.values() for task in known.plan.tasks}
        for run_id in request.get("runs", ()):
            if run_id not in self.index.runs and not (action in FUTURE and run_id in planned):
                raise InputError(f"run {run_id}: not found")
            run = Run.from_id(self.outputs, run_id)
            if action == "delete":
                delete_run(self.outputs, run, "page")
            else:
                change_run(run, action, value, "page")
        self.next_look = 0.0

    def describe_missing(self, path: str) -> str:
        """Return an error message for an unknown path, with the searched folder."""
        kind, _, name = path.partition("/")
        folders = {"run": "runs", "replay": "runs", "sweeps": "sweeps", "searches": "tune"}
        if kind not in folders or not name:
            return f"{path}: not found"
        return f"{name}: not found in {self.outputs / folders[kind]}; is it in another outputs folder?"

    def _get_replay(self, run_id: str, query: Mapping[str, str]) -> dict[str, Any]:
        mode = query.get("mode", MODES[0])
        if mode not in MODES or "clip" not in query:
            raise ValueError(f"mode={mode}: must be {' or '.join(MODES)}, and clip must be given")
        begin = float(query["from"]) if query.get("from") else None
        return self.replays.get(run_id, query["clip"], mode, begin)

    def close(self) -> None:
        """Cancel the waiting computations."""
        self.replays.close()


class RunsHandler(PageHandler):
    """Handles one request to the page's server."""

    server: RunsServer
    protocol_version = "HTTP/1.1"  # keeps connections open
    max_body = 50_000

    def answer(self, path: str, query: Mapping[str, str]) -> None:
        """Send a page file, an answer, or a run file."""
        kind, _, name = path.partition("/")
        if path in ("", *FILES):
            file, content = path or "index.html", read_file(path or "index.html")
            if file == "index.html":
                content = content.replace(b"TOKEN", self.server.change_token.encode())
            self.send(200, find_content_type(file), content)
        elif kind == "api":
            self._send_answer(name, query)
        elif kind == "files":
            self._send_run_file(*name.partition("/")[::2])
        else:
            self._send_json(404, {"error": f"{path}: not found"})

    def do_POST(self) -> None:
        """Change runs, as the page asks."""
        server, given = self.server, self.headers.get("X-Memmlp-Token", "")
        with contextlib.suppress(ConnectionError, TimeoutError):
            is_own = secrets.compare_digest(given.encode(), server.change_token.encode())
            if not (is_own and server.access.allows_change(self.path, self.headers, server.server_port)):
                return self._send_json(403, {"error": "only the page itself may change runs; load it again"})
            if self.path != "/api/change":
                return self._send_json(404, {"error": f"{self.path}: not found"})
            try:
                server.answers.change(json.loads(self.body))
            except (InputError, OSError) as error:
                return self._send_json(400, {"error": str(error)})
            except (ValueError, RecursionError):
                return self._send_json(400, {"error": "must be JSON"})
            self._send_json(200, {})

    def _send_answer(self, path: str, query: Mapping[str, str]) -> None:
        try:
            answer = self.server.answers.answer(path, query)
        except KeyError:
            self._send_json(404, {"error": self.server.answers.describe_missing(path)})
        except (InputError, ValueError, OverflowError) as error:
            self._send_json(400, {"error": str(error)})
        except Exception as error:  # a damaged folder must not stop the server
            self._send_json(500, {"error": f"{type(error).__name__}: {error}"})
        else:
            self._send_json(200, answer)

    def _send_json(self, code: int, value: Mapping[str, Any]) -> None:
        try:
            text = json.dumps(value, separators=(",", ":"), allow_nan=False)
        except ValueError:  # NaN or infinity
            text = json.dumps(make_json_safe(value), separators=(",", ":"), allow_nan=False)
        self.send(code, "application/json", text.encode())

    def _send_run_file(self, run_id: str, name: str) -> None:
        path = self.server.answers.outputs / "runs" / run_id / name
        if not ID.fullmatch(run_id) or name not in runs.VIEWABLE_FILES or not path.is_file():
            self._send_json(404, {"error": "not found"})
            return
        kind = "image/png" if name.endswith(".png") else TEXT
        self.send(200, kind, path.read_bytes(), {"Content-Security-Policy": "default-src 'none'; sandbox"})


class RunsServer(PageServer):
    """The page's HTTP server.

    Args:
        answers: the answers about runs, sweeps and searches.
        port, host, token: see `PageServer`.
    """

    def __init__(self, answers: Answers, port: int, host: str = HOST, token: str | None = None):
        self.answers, self.change_token = answers, secrets.token_urlsafe(24)
        policy = build_security_policy(read_file("index.html").decode())
        self.headers = {"Content-Security-Policy": f"{policy}; frame-ancestors 'none'"}
        super().__init__(RunsHandler, port, host, token)

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        self.answers.close()


UI_PACKAGE, LIVE_PACKAGE, COMMON_PACKAGE = "memmlp.report.ui", "memmlp.live.session", "memmlp.common"
SCRIPTS = {"plot/d3.min.js": UI_PACKAGE, "plot/plot.umd.min.js": UI_PACKAGE}
MODULES = {
    **dict.fromkeys(
        ("main.js", "store.js", "filter.js", "format.js", "charts.js", "runs.js", "run.js", "sweeps.js",
         "searches.js", "curves.js", "replay.js", "now.js", "state.js", "actions.js", "groups.js"),
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
