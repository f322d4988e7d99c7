"""The server of the page: files, answers as JSON, and change events. No request can change a run."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Self

from memmlp.common.errors import InputError
from memmlp.common.files import plain
from memmlp.common.page_server import HOST, TEXT, PageHandler, PageServer, content_type, security_policy
from memmlp.report.ui import page_files, runs
from memmlp.report.ui.replay import Predict, Replays, describe_body
from memmlp.report.ui.run_index import RunIndex
from memmlp.report.ui.searches import Searches
from memmlp.report.ui.sweeps import Sweeps
from memmlp.runs.identity import ID
from memmlp.sweep.definition import MODES

MAX_CURVES = 60  # runs with curves in one answer
HEARTBEAT = 15.0  # seconds without a change after which a comment shows that the connection lives


class Answers:
    """Answers the page's questions about an outputs folder.

    Args:
        outputs: the folder of runs and caches.
        predict: computes a run's prediction for a test clip; None to show stored ones alone.
    """

    def __init__(self, outputs: Path, predict: Predict | None = None):
        self.outputs = outputs
        self.index = RunIndex(outputs)
        self.sweeps, self.searches = Sweeps(self.index), Searches(outputs)
        self.curves, self.replays = runs.Curves(outputs), Replays(outputs, predict)
        self.refreshed = False

    def refresh(self) -> str:
        """Look at everything again, and return a text that changes whenever anything has changed."""
        generation = self.index.refresh()
        self.refreshed = True
        return f"{generation} {hash((self.sweeps.refresh(), self.searches.stamp()))}"

    def places(self) -> dict[str, list[dict[str, Any]]]:
        """Return the sweeps and searches that use a run, by run id."""
        found: dict[str, list[dict[str, Any]]] = {}
        for name, known in self.sweeps.known.items():
            for entry in known.plan.entries:
                place = {"sweep": name, "variant": entry.label, "seed": entry.seed}
                found.setdefault(entry.id, []).append(place)
        for search, number, run_id in self.searches.runs():
            found.setdefault(run_id, []).append({"search": search, "trial": number})
        return found

    def answer(self, path: str, query: Mapping[str, str]) -> Mapping[str, Any]:
        """Return the answer to a question, such as "run/0123456789abcdef".

        Raises:
            KeyError: if there is nothing with that name.
            ValueError: for a text that should be a number.
        """
        if not self.refreshed:
            self.refresh()
        kind, _, name = path.partition("/")
        match kind, bool(name):
            case "runs", False:
                since = int(query.get("since", 0))
                rows = runs.list_rows(self.index, self.places(), since, query.get("heads", ""))
                return {**rows, "outputs": str(self.outputs.absolute())}
            case "curves", False:
                known = [one for one in ID.findall(query.get("runs", "")) if one in self.index.runs]
                return {"curves": {run_id: self.curves.read(run_id) for run_id in known[:MAX_CURVES]}}
            case "body", False:
                return describe_body()
            case "sweeps", _:
                return self.sweeps.describe(name) if name else self.sweeps.list_rows()
            case "searches", _:
                return self.searches.describe(name) if name else self.searches.list_rows()
            case (("run" | "replay"), True) if ID.fullmatch(name) and name in self.index.runs:
                if kind == "replay":
                    return self._replay(name, query)
                return runs.describe_run(self.index, name, self.sweeps.find_control(name), self.places())
        raise KeyError(path)

    def missing(self, path: str) -> str:
        """Return a message that there is nothing with that name, and where it would be."""
        kind, _, name = path.partition("/")
        folders = {"run": "runs", "replay": "runs", "sweeps": "sweeps", "searches": "tune"}
        if kind not in folders or not name:
            return f"{path}: there is no such page"
        return f"{name}: not found in {self.outputs / folders[kind]}; is it in another outputs folder?"

    def _replay(self, run_id: str, query: Mapping[str, str]) -> dict[str, Any]:
        mode = query.get("mode", MODES[0])
        if mode not in MODES or "clip" not in query:
            raise ValueError(f"mode={mode}: must be {' or '.join(MODES)}, with a clip")
        begin = float(query["from"]) if query.get("from") else None
        return self.replays.get(run_id, query["clip"], mode, begin)

    def close(self) -> None:
        """Cancel the computations that are still waiting."""
        self.replays.close()


class Watch:
    """Looks at the runs repeatedly while a page is open, and reports changes."""

    def __init__(self, look: Callable[[], str], every: float = 1.0):
        self.look, self.every = look, every
        self.condition = threading.Condition()
        self.pages, self.closed = 0, False
        self.state = ""

    def wait(self, known: str, timeout: float = HEARTBEAT) -> str:
        """Wait, at most `timeout` seconds, until the state differs from a known one; return the state."""
        with self.condition:
            self.condition.wait_for(lambda: self.closed or self.state not in ("", known), timeout)
            return self.state

    def loop(self) -> None:
        """Look repeatedly until closed; looking takes at most a tenth of the time."""
        while not self.closed:
            started = time.monotonic()
            if self.pages or not self.state:
                state = self.look()
                with self.condition:
                    self.state = state
                    self.condition.notify_all()
            pause = max(self.every, 9 * (time.monotonic() - started))
            with self.condition:
                self.condition.wait_for(lambda: self.closed, pause)

    def events(self) -> Iterator[bytes]:
        """Yield the state as an event at each change, until closed; without changes a comment."""
        self.pages += 1
        try:
            known = "-"
            while not self.closed:
                state = self.wait(known)
                yield b": quiet\n\n" if state == known else f"data: {json.dumps(state)}\n\n".encode()
                known = state
        finally:
            self.pages -= 1

    def close(self) -> None:
        """End the loop, and wake all waiting threads."""
        with self.condition:
            self.closed = True
            self.condition.notify_all()


class RunsHandler(PageHandler):
    """Answers one request."""

    server: RunsServer
    protocol_version = "HTTP/1.1"  # keeps connections open

    def answer(self, path: str, query: Mapping[str, str]) -> None:
        """Send a file of the page, an answer, or the stream of changes until its end."""
        kind, _, name = path.partition("/")
        if path in ("", *page_files.FILES):
            file = path or "index.html"
            self.send(200, content_type(file), page_files.read(file))
        elif path == "events":
            self.send_events(self.server.watch.events())
        elif kind == "api":
            self._send_answer(name, query)
        elif kind == "files":
            self._send_run_file(*name.partition("/")[::2])
        else:
            self._send_json(404, {"error": f"{path}: not found"})

    def _send_answer(self, path: str, query: Mapping[str, str]) -> None:
        try:
            found = self.server.answers.answer(path, query)
        except KeyError:
            self._send_json(404, {"error": self.server.answers.missing(path)})
        except (InputError, ValueError, OverflowError) as error:
            self._send_json(400, {"error": str(error)})
        except Exception as error:  # one damaged folder must not look like the server's end
            self._send_json(500, {"error": f"{type(error).__name__}: {error}"})
        else:
            self._send_json(200, found)

    def _send_json(self, code: int, value: Mapping[str, Any]) -> None:
        try:
            text = json.dumps(value, separators=(",", ":"), allow_nan=False)
        except ValueError:  # NaN or infinity
            text = json.dumps(plain(value), separators=(",", ":"), allow_nan=False)
        self.send(code, "application/json", text.encode())

    def _send_run_file(self, run_id: str, name: str) -> None:
        path = self.server.answers.outputs / "runs" / run_id / name
        if not ID.fullmatch(run_id) or name not in runs.VIEWABLE or not path.is_file():
            self._send_json(404, {"error": "not found"})
            return
        kind = "image/png" if name.endswith(".png") else TEXT
        self.send(200, kind, path.read_bytes(), {"Content-Security-Policy": "default-src 'none'; sandbox"})


class RunsServer(PageServer):
    """Serves the page, as `PageServer` does.

    Args:
        answers: the answers about runs, sweeps and searches.
        port, host, token: as in `PageServer`.
        every: the least number of seconds between two looks at the runs.
    """

    def __init__(
        self, answers: Answers, port: int, host: str = HOST, token: str | None = None, every: float = 1.0
    ):
        self.answers = answers
        policy = security_policy(page_files.read("index.html").decode())
        self.headers = {"Content-Security-Policy": f"{policy}; frame-ancestors 'none'"}
        self.watch = Watch(answers.refresh, every)
        super().__init__(RunsHandler, port, host, token)

    def end_events(self) -> None:
        """End the events of all pages."""
        self.watch.close()

    def __enter__(self) -> Self:
        self.watcher = threading.Thread(target=self.watch.loop, daemon=True)
        self.watcher.start()
        return super().__enter__()

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        self.watcher.join()
        self.answers.close()
