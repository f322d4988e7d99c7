"""The server of the page: it serves the page's files, sends frames as server-sent events, and takes orders.

It listens on 127.0.0.1 unless another address is asked for; in that case every request needs a token. Pages
may be opened and closed at any time; a slow page misses frames, and does not delay the others.
"""

from __future__ import annotations

import contextlib
import errno
import json
import queue
import socket
import threading
import urllib.parse
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, NamedTuple

from memmlp.common.errors import InputError
from memmlp.common.request_access import Access
from memmlp.live.session.sources import EVERYWHERE, HOST

QUEUED = 240  # the most events that wait for a watcher; beyond, its oldest frames are dropped
FRAME = b"event: frame\n"  # how a frame's event begins
QUIET = 2.0  # seconds without a frame after which a comment shows that the connection lives
LARGEST = 1000  # bytes of an order
SCRIPT, STYLE, HTML = (
    "text/javascript; charset=utf-8",
    "text/css; charset=utf-8",
    "text/html; charset=utf-8",
)
SCRIPTS = ("main.js", "stage.js", "history.js", "wearer.js", "avatar.js")
THREE = ("three/three.module.min.js", "three/three.core.min.js", "three/OrbitControls.js")


class File(NamedTuple):
    """A file of the page.

    Attributes:
        kind: the file's content type.
        read: returns the file's content.
    """

    kind: str
    read: Callable[[], bytes]


def read_page(name: str) -> bytes:
    """Return the content of a file of the page, which is part of the package."""
    return resources.files("memmlp.live.session").joinpath("page", name).read_bytes()


FILES: dict[str, File] = {
    "": File(HTML, partial(read_page, "index.html")),
    **{name: File(SCRIPT, partial(read_page, name)) for name in (*SCRIPTS, *THREE)},
    "style.css": File(STYLE, partial(read_page, "style.css")),
}


class Hub:
    """Hands frames to all watchers, which are the open pages.

    Args:
        greeting: the message that each watcher gets first.
    """

    def __init__(self, greeting: Mapping[str, Any]):
        self.states = {"greeting": event("greeting", greeting)}
        self.watchers: set[queue.Queue[bytes | None]] = set()
        self.lock = threading.Lock()
        self.closed = False

    def publish(self, message: Mapping[str, Any]) -> None:
        """Hand a frame's message to all present watchers."""
        self._hand(event("frame", message))

    def tell(self, name: str, state: Mapping[str, Any]) -> None:
        """Hand a state to all present watchers, and to later ones until the state changes."""
        line = event(name, state)
        with self.lock:
            self.states[name] = line
        self._hand(line)

    def _hand(self, line: bytes) -> None:
        with self.lock:
            for watcher in self.watchers:
                _put(watcher, line)

    @contextlib.contextmanager
    def watch(self) -> Iterator[queue.Queue[bytes | None]]:
        """Give a watcher a queue of events for as long as it watches; None in the queue means the end."""
        watcher: queue.Queue[bytes | None] = queue.Queue(QUEUED)
        with self.lock:
            for state in self.states.values():
                watcher.put(state)
            if self.closed:
                _put(watcher, None)
            self.watchers.add(watcher)
        try:
            yield watcher
        finally:
            with self.lock:
                self.watchers.discard(watcher)

    def close(self) -> None:
        """End the stream of events of every watcher, and of each that comes later."""
        with self.lock:
            self.closed = True
            for watcher in self.watchers:
                _put(watcher, None)


def _put(watcher: queue.Queue[bytes | None], line: bytes | None) -> None:
    """Append a line to a watcher's queue; if the queue is full, drop its oldest frame.

    States stay, since a page would go on showing the one before. Only of a queue without frames the oldest
    line is dropped.
    """
    with watcher.mutex:
        waiting = watcher.queue
        if len(waiting) >= watcher.maxsize:
            frames = (at for at, one in enumerate(waiting) if one and one.startswith(FRAME))
            del waiting[next(frames, 0)]
    watcher.put_nowait(line)


def event(name: str, value: Mapping[str, Any]) -> bytes:
    """Return a server-sent event."""
    return f"event: {name}\ndata: {json.dumps(value, separators=(',', ':'))}\n\n".encode()


class LiveHandler(BaseHTTPRequestHandler):
    """Answers one request of a page."""

    server: LiveServer

    def do_GET(self) -> None:
        """Send a file of the page, or the stream of events until its end."""
        url, access, port = urllib.parse.urlsplit(self.path), self.server.access, self.server.server_port
        name = url.path.lstrip("/")
        with contextlib.suppress(ConnectionError):  # raised when the page was closed
            if not access.allows(self.path, self.headers, port):
                self.send_error(403)
            elif token := access.token_in(url.query):
                self._head(303, "text/plain", access.redirect_headers(token, port))
            elif name == "events":
                self._events()
            elif name in self.server.files:
                self._file(self.server.files[name])
            else:
                self.send_error(404)

    def do_POST(self) -> None:
        """Take an order from the page; the answer is empty, or a line that says what is wrong with it."""
        with contextlib.suppress(ConnectionError):
            if not self.server.access.allows_change(self.path, self.headers, self.server.server_port):
                self.send_error(403)
            elif self.path != "/wearer" or self.server.ask is None:
                self.send_error(404)
            else:
                self._order(self.server.ask)

    def _order(self, ask: Callable[[object], None]) -> None:
        try:
            size = min(int(self.headers.get("Content-Length", 0)), LARGEST)
            ask(json.loads(self.rfile.read(size)))
        except (ValueError, RecursionError) as error:
            said = str(error) if isinstance(error, InputError) else "no JSON"
            self._send(400, "text/plain; charset=utf-8", said.encode())
        else:
            self._send(200, "text/plain; charset=utf-8", b"")

    def _file(self, file: File) -> None:
        self._send(200, file.kind, file.read())

    def _send(self, code: int, kind: str, content: bytes) -> None:
        self._head(code, kind, {"Content-Length": str(len(content))})
        self.wfile.write(content)

    def _events(self) -> None:
        """Send the greeting and all frames as they come, until the page or the server is closed."""
        self._head(200, "text/event-stream", {})
        with self.server.hub.watch() as watcher:
            while True:
                try:
                    line = watcher.get(timeout=QUIET)
                except queue.Empty:
                    line = b": quiet\n\n"
                if line is None:
                    return
                self.wfile.write(line)

    def _head(self, code: int, kind: str, headers: Mapping[str, str]) -> None:
        self.send_response(code)
        safe = {
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
        }
        for name, value in {"Content-Type": kind, **safe, **headers}.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing, since requests are not worth a line."""


class LiveServer(ThreadingHTTPServer):
    """Serves the page, from threads of its own, inside a `with` block.

    Args:
        hub: gives the frames to the pages.
        port: the port; 0 for any free one.
        host: the address to serve at; 127.0.0.1 is this machine alone.
        token: what every request needs at any other address; None for a new random token.
        files: the page's files, by their paths.
        ask: takes an order from the page, or raises InputError; None where the stream takes no orders.

    Raises:
        InputError: if the address does not belong to this machine, or the port is taken.
    """

    daemon_threads = True
    block_on_close = False

    def __init__(
        self,
        hub: Hub,
        port: int,
        host: str = HOST,
        token: str | None = None,
        files: Mapping[str, File] = FILES,
        ask: Callable[[object], None] | None = None,
    ):
        self.hub, self.files, self.ask = hub, files, ask
        self.access = Access(host, token)
        try:
            super().__init__((host, port), LiveHandler)
        except (OSError, OverflowError) as error:
            taken = getattr(error, "errno", None) == errno.EADDRINUSE
            reason = "taken" if taken else getattr(error, "strerror", None) or error
            allowed = "allowed are this machine's addresses and free ports (--port 0: any that is free)"
            raise InputError(f"--host {host} --port {port}: {reason}; {allowed}") from None

    def server_bind(self) -> None:
        """Bind to the address, without asking a name server for the host's name."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = name, port, *_ = self.socket.getsockname()
        self.server_name, self.server_port = name, port

    @property
    def url(self) -> str:
        """The page's address, with the token if one is needed.

        A server at all addresses gives one that other machines can reach.
        """
        name = own_address() if self.server_name == EVERYWHERE else str(self.server_name)
        return self.access.url(name, self.server_port)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore the error, since a request that one page breaks off does not concern the others."""

    def __enter__(self) -> LiveServer:
        self.thread = threading.Thread(target=self.serve_forever, args=(0.05,), daemon=True)
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.hub.close()
        self.shutdown()
        self.thread.join()
        self.server_close()


def own_address() -> str:
    """Return this machine's address in its network, at which other machines reach it; nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address for documentation (RFC 5737)
        except OSError:
            return HOST
        return str(probe.getsockname()[0])
