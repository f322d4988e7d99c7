"""The server of the page: its files, and the frames as server-sent events, by the standard library alone.

It listens on 127.0.0.1 only. Watchers come and go; a slow one misses frames, and holds up nobody.
"""

from __future__ import annotations

import contextlib
import json
import queue
import socket
import threading
from collections.abc import Iterator, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any

from memmlp.live.player.sources import HOST, bound

QUEUED = 240  # the most frames that wait for a watcher; beyond, its oldest are dropped
QUIET = 2.0  # seconds without a frame after which a comment shows that the connection lives
FILES = {
    "": ("index.html", "text/html; charset=utf-8"),
    **{name: (name, "text/javascript; charset=utf-8") for name in ("main.js", "stage.js", "history.js")},
    **{
        f"three/{name}": (f"three/{name}", "text/javascript; charset=utf-8")
        for name in ("three.module.min.js", "three.core.min.js", "OrbitControls.js")
    },
    "style.css": ("style.css", "text/css; charset=utf-8"),
}


class Hub:
    """Hands frames to all watchers.

    Args:
        greeting: what each watcher gets first.
    """

    def __init__(self, greeting: Mapping[str, Any]):
        self.greeting = event("greeting", greeting)
        self.watchers: set[queue.Queue[bytes | None]] = set()
        self.lock = threading.Lock()
        self.closed = False

    def publish(self, message: Mapping[str, Any]) -> None:
        """Hand a message to all who watch now."""
        line = event("frame", message)
        with self.lock:
            for watcher in self.watchers:
                _put(watcher, line)

    @contextlib.contextmanager
    def watch(self) -> Iterator[queue.Queue[bytes | None]]:
        """Give a watcher a queue of events for as long as it watches; None in it is the end."""
        watcher: queue.Queue[bytes | None] = queue.Queue(QUEUED)
        watcher.put(self.greeting)
        with self.lock:
            if self.closed:
                _put(watcher, None)
            self.watchers.add(watcher)
        try:
            yield watcher
        finally:
            with self.lock:
                self.watchers.discard(watcher)

    def close(self) -> None:
        """Send everybody away."""
        with self.lock:
            self.closed = True
            for watcher in self.watchers:
                _put(watcher, None)


def _put(watcher: queue.Queue[bytes | None], line: bytes | None) -> None:
    """Append a line to a watcher's queue; where that is full, its oldest line goes."""
    try:
        watcher.put_nowait(line)
    except queue.Full:
        with contextlib.suppress(queue.Empty):
            watcher.get_nowait()
        watcher.put_nowait(line)


def event(name: str, value: Mapping[str, Any]) -> bytes:
    """Return a server-sent event."""
    return f"event: {name}\ndata: {json.dumps(value, separators=(',', ':'))}\n\n".encode()


class Handler(BaseHTTPRequestHandler):
    """Answers one request of a page."""

    server: Server

    def do_GET(self) -> None:
        """Send a file of the page, or the events until the end."""
        name = self.path.partition("?")[0].lstrip("/")
        if self.headers.get("Host", "").partition(":")[0] not in (HOST, "localhost"):  # DNS rebinding
            self.send_error(403)
            return
        with contextlib.suppress(ConnectionError):  # raised when the page was closed
            if name == "events":
                self._events()
            elif name in FILES:
                self._file(*FILES[name])
            else:
                self.send_error(404)

    def _file(self, name: str, kind: str) -> None:
        content = resources.files("memmlp.live.player").joinpath("page", name).read_bytes()
        self._head(kind, {"Content-Length": str(len(content))})
        self.wfile.write(content)

    def _events(self) -> None:
        """Send the greeting and all frames as they come, until the page or the server is closed."""
        self._head("text/event-stream", {})
        with self.server.hub.watch() as watcher:
            while True:
                try:
                    line = watcher.get(timeout=QUIET)
                except queue.Empty:
                    line = b": quiet\n\n"
                if line is None:
                    return
                self.wfile.write(line)

    def _head(self, kind: str, headers: Mapping[str, str]) -> None:
        self.send_response(200)
        for name, value in {"Content-Type": kind, "Cache-Control": "no-store", **headers}.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing, for requests are no news."""


class Server(ThreadingHTTPServer):
    """Serves the page, from threads of its own, inside a `with` block.

    Args:
        hub: gives the frames to the pages.
        port: the port; 0 for any free one.

    Raises:
        InputError: where the port is taken.
    """

    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True

    def __init__(self, hub: Hub, port: int):
        self.hub, self.wanted = hub, port
        super().__init__((HOST, port), Handler)

    def server_bind(self) -> None:
        """Bind to the port of this machine."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound(self.socket, self.wanted)
        self.server_address = (HOST, self.socket.getsockname()[1])
        self.server_name, self.server_port = self.server_address

    @property
    def url(self) -> str:
        """The page's address."""
        return f"http://{HOST}:{self.server_port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore the error, for what one page breaks off does not concern the others."""

    def __enter__(self) -> Server:
        self.thread = threading.Thread(target=self.serve_forever, args=(0.05,), daemon=True)
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.hub.close()
        self.shutdown()
        self.thread.join()
        self.server_close()
