"""The server of the page, made with the standard library alone: files, answers as JSON, and change events.

It serves this machine alone, unless another address is asked for; in that case every request needs the token.
It only reads: nothing that a page sends can change a run.
"""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
import urllib.parse
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import plain
from memmlp.common.request_access import LOCAL, Access
from memmlp.report.ui import pages
from memmlp.report.ui.routes import Answers
from memmlp.runs.identity import ID

QUIET = 15.0  # seconds without news after which a comment shows that the connection lives


class Watch:
    """Looks at the runs repeatedly while somebody watches, and reports when something has changed."""

    def __init__(self, look: Callable[[], str], every: float = 1.0):
        self.look, self.every = look, every
        self.condition = threading.Condition()
        self.watchers, self.closed = 0, False
        self.state = ""

    def wait(self, known: str, timeout: float = QUIET) -> str:
        """Wait, at most `timeout` seconds, until the state differs from a known one; return the state."""
        with self.condition:
            self.condition.wait_for(lambda: self.closed or self.state not in ("", known), timeout)
            return self.state

    def loop(self) -> None:
        """Look repeatedly until closed; looking takes at most a tenth of the time."""
        while not self.closed:
            began = time.monotonic()
            if self.watchers or not self.state:
                state = self.look()
                with self.condition:
                    self.state = state
                    self.condition.notify_all()
            pause = max(self.every, 9 * (time.monotonic() - began))
            with self.condition:
                self.condition.wait_for(lambda: self.closed, pause)

    def close(self) -> None:
        """End the loop, and wake all waiting threads."""
        with self.condition:
            self.closed = True
            self.condition.notify_all()


class RunsHandler(BaseHTTPRequestHandler):
    """Answers one request."""

    server: RunsServer
    protocol_version = "HTTP/1.1"
    timeout = 60

    def do_GET(self) -> None:
        """Send a file of the page, an answer, or the stream of changes until its end."""
        with contextlib.suppress(ConnectionError, TimeoutError):  # raised when the page was closed
            url = urllib.parse.urlsplit(self.path)
            query = dict(urllib.parse.parse_qsl(url.query))
            access, port = self.server.access, self.server.server_port
            if not access.allows(self.path, self.headers, port):
                self._send(
                    403,
                    "text/plain; charset=utf-8",
                    b"not allowed; open the address that memmlp ui printed\n",
                )
            elif "token" in query:
                self._send(303, "text/plain", b"", access.redirect_headers(query["token"], port))
            else:
                self._route(urllib.parse.unquote(url.path).lstrip("/"), query)

    def _route(self, name: str, query: Mapping[str, str]) -> None:
        if name in ("", *pages.FILES):
            file = name or "index.html"
            self._send(200, pages.content_type(file), pages.read(file))
        elif name == "events":
            self._events()
        elif name.startswith("api/"):
            self._answer(name.removeprefix("api/"), query)
        elif name.startswith("files/"):
            self._file(*name.removeprefix("files/").partition("/")[::2])
        else:
            self._missing()

    def _answer(self, name: str, query: Mapping[str, str]) -> None:
        try:
            found = self.server.answers.of(name, query)
        except KeyError:
            self._json(404, {"error": self.server.answers.missing(name)})
        except (InputError, ValueError, OverflowError) as error:
            self._json(400, {"error": str(error)})
        except Exception as error:  # one folder's damage must not look like the server's end
            self._json(500, {"error": f"{type(error).__name__}: {error}"})
        else:
            self._json(200, found)

    def _json(self, code: int, value: Mapping[str, Any]) -> None:
        try:
            text = json.dumps(value, separators=(",", ":"), allow_nan=False)
        except ValueError:  # a number that JSON has no word for
            text = json.dumps(plain(value), separators=(",", ":"), allow_nan=False)
        self._send(code, "application/json", text.encode())

    def _file(self, run_id: str, name: str) -> None:
        """Send a file of a run, one of a short list of names."""
        from memmlp.report.ui.runs import SHOWN_FILES

        path = self.server.answers.index.outputs / "runs" / run_id / name
        if not ID.fullmatch(run_id) or name not in SHOWN_FILES or not path.is_file():
            self._missing()
            return
        kind = "image/png" if name.endswith(".png") else "text/plain; charset=utf-8"
        self._send(200, kind, path.read_bytes(), {"Content-Security-Policy": "default-src 'none'; sandbox"})

    def _missing(self) -> None:
        self._json(404, {"error": "nothing is here"})

    def _events(self) -> None:
        """Send each change until the page or the server is closed."""
        watch = self.server.watch
        self._head(200, {"Content-Type": "text/event-stream", "Connection": "close"})
        self.close_connection = True
        watch.watchers += 1
        try:
            known = "-"
            while not watch.closed:
                state = watch.wait(known)
                self.wfile.write(
                    b": quiet\n\n" if state == known else f"data: {json.dumps(state)}\n\n".encode()
                )
                self.wfile.flush()
                known = state
        finally:
            watch.watchers -= 1

    def _send(self, code: int, kind: str, content: bytes, headers: Mapping[str, str] | None = None) -> None:
        self._head(code, {"Content-Type": kind, "Content-Length": str(len(content)), **(headers or {})})
        self.wfile.write(content)

    def _head(self, code: int, headers: Mapping[str, str]) -> None:
        self.send_response(code)
        safe = {
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Content-Security-Policy": self.server.policy,
        }
        for name, value in (safe | dict(headers)).items():
            self.send_header(name, value)
        self.end_headers()

    def version_string(self) -> str:
        """Return the name of the server."""
        return "memmlp"

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing, since requests are not worth a line."""


class RunsServer(ThreadingHTTPServer):
    """Serves the page, from threads of its own, inside a `with` block.

    Args:
        answers: the answers about runs, sweeps and searches.
        port: the port; 0 for any free one.
        host: the address to serve at; 127.0.0.1 is this machine alone.
        token: what every request needs at any other address; None for a new random token.
        every: the least number of seconds between two looks at the runs.

    Raises:
        InputError: if the address does not belong to this machine, or the port is taken.
    """

    daemon_threads = True
    block_on_close = False

    def __init__(
        self, answers: Answers, port: int, host: str = LOCAL[0], token: str | None = None, every: float = 1.0
    ):
        self.answers, self.policy = answers, pages.policy()
        self.access = Access(host, token)
        self.watch = Watch(answers.look, every)
        try:
            super().__init__((host, port), RunsHandler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            allowed = "allowed are this machine's addresses and free ports (--port 0: any that is free)"
            raise InputError(f"--host {host} --port {port}: {reason}; {allowed}") from None

    def server_bind(self) -> None:
        """Bind to the address, without asking a name server for the host's name.

        Connections of a page that was left open do not keep a server of before in the way.
        """
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = name, port, *_ = self.socket.getsockname()
        self.server_name, self.server_port = name, port

    @property
    def url(self) -> str:
        """The page's address, with the token if one is needed."""
        return self.access.url(self.server_name, self.server_port)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore the error, since a request that one page breaks off does not concern the others."""

    def __enter__(self) -> RunsServer:
        self.threads = [threading.Thread(target=work, daemon=True) for work in (self._serve, self.watch.loop)]
        for thread in self.threads:
            thread.start()
        return self

    def _serve(self) -> None:
        self.serve_forever(0.05)

    def __exit__(self, *_: object) -> None:
        self.watch.close()
        self.shutdown()
        for thread in self.threads:
            thread.join()
        self.server_close()
        self.answers.close()
