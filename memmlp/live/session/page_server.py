"""The server of the page: it serves the page's files, sends frames as server-sent events, and takes orders.

It listens on 127.0.0.1 unless another address is requested; in that case every request needs a token. Pages
may be opened and closed at any time; a slow page misses frames, and does not delay the others.
"""

from __future__ import annotations

import contextlib
import errno
import json
import queue
import socket
import struct
import tempfile
import threading
import urllib.parse
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from memmlp.common import npm
from memmlp.common.errors import InputError, why_unreadable
from memmlp.common.request_access import Access
from memmlp.live.session.sources import EVERYWHERE, HOST
from memmlp.motion.formats.vrm import write_vrm

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
AVATAR_SCRIPTS = {
    npm.THREE: ("build/three.module.js", "build/three.core.js", "examples/jsm/loaders/GLTFLoader.js",
                "examples/jsm/utils/BufferGeometryUtils.js", "examples/jsm/utils/SkeletonUtils.js"),
    npm.THREE_VRM: ("lib/three-vrm.module.min.js",),
}  # fmt: skip
EXTENSIONS = ("VRMC_vrm", "VRM")  # of VRM 1.0, and 0.x


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


def avatar_files(vrm: bytes) -> dict[str, File]:
    """Return the page's files with a VRM avatar, and three-vrm from its npm package.

    The page's three.js is replaced by that of the npm package to which the loader belongs.

    Raises:
        InputError: if an npm package can't be downloaded.
    """
    page = read_page("index.html").replace(b"./three/three.module.min.js", b"./npm/build/three.module.js")
    files = FILES | {"": File(HTML, lambda: page), "avatar.vrm": File("model/gltf-binary", lambda: vrm)}
    for package, names in AVATAR_SCRIPTS.items():
        for name, content in npm.read(package, names).items():
            files[f"npm/{name}"] = File(SCRIPT, partial(bytes, content))
    return files


def mannequin_vrm(rest: np.ndarray) -> bytes:
    """Return the built-in avatar as a VRM file, with the given rest joints (22, 3), metres."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mannequin.vrm"
        write_vrm(path, rest)
        return path.read_bytes()


def read_vrm(path: Path) -> bytes:
    """Return a VRM file's content. Raises InputError if the file is not a VRM file."""
    try:
        content = path.read_bytes()
        if content[:4] != b"glTF":
            raise ValueError("not a binary glTF")
        (size,) = struct.unpack_from("<I", content, 12)
        extensions = json.loads(content[20 : 20 + size]).get("extensions", {})
    except (OSError, ValueError, struct.error, AttributeError) as error:
        raise InputError(f"--avatar {path}: {why_unreadable(error)}; expected a VRM file") from None
    if not any(name in extensions for name in EXTENSIONS):
        raise InputError(f"--avatar {path}: a glTF file without a VRM avatar; expected a VRM file")
    return content


class Hub:
    """Hands frames to all watchers, which are the open pages.

    Args:
        greeting: the message that each watcher gets first.
    """

    def __init__(self, greeting: Mapping[str, Any]):
        self.states = {"greeting": to_event("greeting", greeting)}
        self.watchers: set[queue.Queue[bytes | None]] = set()
        self.lock = threading.Lock()
        self.closed = False

    def publish(self, message: Mapping[str, Any]) -> None:
        """Hand a frame's message to all current watchers."""
        self._hand(to_event("frame", message))

    def tell(self, name: str, state: Mapping[str, Any]) -> None:
        """Hand a state to all current watchers, and to later ones until the state changes."""
        line = to_event(name, state)
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

    States stay, since a page would go on showing the one before. A queue without frames drops its oldest
    line.
    """
    with watcher.mutex:
        waiting = watcher.queue
        if len(waiting) >= watcher.maxsize:
            frames = (at for at, one in enumerate(waiting) if one and one.startswith(FRAME))
            del waiting[next(frames, 0)]
    watcher.put_nowait(line)


def to_event(name: str, value: Mapping[str, Any]) -> bytes:
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
                self._send_events()
            elif name in self.server.files:
                file = self.server.files[name]
                self._send(200, file.kind, file.read())
            else:
                self.send_error(404)

    def do_POST(self) -> None:
        """Take an order from the page; the answer is empty, or a line about its error."""
        ask = self.server.ask
        with contextlib.suppress(ConnectionError):
            if not self.server.access.allows_change(self.path, self.headers, self.server.server_port):
                return self.send_error(403)
            if self.path != "/wearer" or ask is None:
                return self.send_error(404)
            try:
                size = min(int(self.headers.get("Content-Length", 0)), LARGEST)
                ask(json.loads(self.rfile.read(size)))
            except (ValueError, RecursionError) as error:
                said = str(error) if isinstance(error, InputError) else "not JSON"
                self._send(400, "text/plain; charset=utf-8", said.encode())
            else:
                self._send(200, "text/plain; charset=utf-8", b"")

    def _send(self, code: int, kind: str, content: bytes) -> None:
        self._head(code, kind, {"Content-Length": str(len(content))})
        self.wfile.write(content)

    def _send_events(self) -> None:
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
    """Serves the page, from its own threads, inside a `with` block.

    Args:
        hub: gives the frames to the pages.
        port: the port; 0 for any free one.
        host: the address to serve at; at 127.0.0.1 only this machine reaches it.
        token: every request's token at any other address; None for a new random token.
        files: the page's files, by their paths.
        ask: takes an order from the page, or raises InputError; None to reject all orders.

    Raises:
        InputError: if the address does not belong to this machine, or the port is in use.
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
            in_use = getattr(error, "errno", None) == errno.EADDRINUSE
            reason = "in use" if in_use else getattr(error, "strerror", None) or error
            expected = "expected an address of this machine and a free port (--port 0: any that is free)"
            raise InputError(f"--host {host} --port {port}: {reason}; {expected}") from None

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
