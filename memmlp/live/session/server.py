"""The server of the live page. It sends files and frames (server-sent events), and receives commands. Pages
may be opened and closed at any time. A slow page misses frames, but does not delay other pages."""

from __future__ import annotations

import contextlib
import json
import struct
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from memmlp.common import npm
from memmlp.common.errors import InputError, describe_read_error
from memmlp.common.page_server import HOST, TEXT, PageHandler, PageServer, find_content_type, read_page_file

QUEUED = 240  # maximum number of queued frames for a page; older frames are dropped
QUIET = 2.0  # seconds without a frame before a comment keeps the connection alive
PAGE = (
    "index.html", "live.css", "main.js", "viewer.js", "stage.js", "wearer.js", "avatar.js",
    "three/three.module.min.js", "three/three.core.min.js", "three/OrbitControls.js",
)  # fmt: skip
COMMON = ("style.css", "dom.js")  # shared with memmlp's other pages
AVATAR_SCRIPTS = {
    npm.THREE: ("build/three.module.js", "build/three.core.js", "examples/jsm/loaders/GLTFLoader.js",
                "examples/jsm/utils/BufferGeometryUtils.js", "examples/jsm/utils/SkeletonUtils.js"),
    npm.THREE_VRM: ("lib/three-vrm.module.min.js",),
}  # fmt: skip
EXTENSIONS = ("VRMC_vrm", "VRM")  # of VRM 1.0, and 0.x


def load_page_files(vrm: bytes | None = None) -> dict[str, bytes]:
    """Return the files of the page by name. With a VRM avatar, they include the avatar and three-vrm, and
    three.js from its npm package, which contains the loader. Raises InputError if a package cannot be
    downloaded."""
    files = {name: read_page_file("memmlp.live.session", name) for name in PAGE}
    files |= {name: read_page_file("memmlp.common", name) for name in COMMON}
    if vrm is None:
        return files
    page = files["index.html"].replace(b"./three/three.module.min.js", b"./npm/build/three.module.js")
    scripts = {
        f"npm/{name}": content
        for package, names in AVATAR_SCRIPTS.items()
        for name, content in npm.read_package_files(package, names).items()
    }
    return files | scripts | {"index.html": page, "avatar.vrm": vrm}


def read_vrm(path: Path) -> bytes:
    """Return the content of a VRM file. Raises InputError if it is not a VRM file."""
    try:
        content = path.read_bytes()
        if content[:4] != b"glTF":
            raise ValueError("not a binary glTF")
        (size,) = struct.unpack_from("<I", content, 12)
        extensions = json.loads(content[20 : 20 + size]).get("extensions", {})
    except (OSError, ValueError, struct.error, AttributeError) as error:
        raise InputError(f"--avatar {path}: {describe_read_error(error)}; expected a VRM file") from None
    if not any(name in extensions for name in EXTENSIONS):
        raise InputError(f"--avatar {path}: is glTF without a VRM avatar; expected a VRM file")
    return content


class Hub:
    """Sends states and frames to all open pages; `greeting` is the first state for each page."""

    def __init__(self, greeting: Mapping[str, Any]):
        self.changed = threading.Condition()
        self.states: dict[str, tuple[int, bytes]] = {}  # number and event of the newest state, by name
        self.frames: deque[tuple[int, bytes]] = deque(maxlen=QUEUED)
        self.count, self.closed = 0, False
        self.publish_state("greeting", greeting)

    def publish(self, message: Mapping[str, Any]) -> None:
        with self.changed:
            self.frames.append((self._count_up(), encode_event("frame", message)))

    def publish_state(self, name: str, state: Mapping[str, Any]) -> None:
        """Send a state to all open pages, and to later pages until the state changes."""
        with self.changed:
            self.states[name] = self._count_up(), encode_event(name, state)

    def _count_up(self) -> int:
        self.count += 1
        self.changed.notify_all()
        return self.count

    def stream_events(self) -> Iterator[bytes]:
        """Yield the current states, then all new events, until the hub is closed."""
        seen, frames_from = 0, self.count
        while not self.closed:
            with self.changed:
                if self.count == seen and not self.closed:
                    self.changed.wait(QUIET)
                frames = [one for one in self.frames if one[0] > frames_from]
                news = sorted(one for one in (*self.states.values(), *frames) if one[0] > seen)
                seen = self.count
            yield b"".join(event for _, event in news) or b": quiet\n\n"

    def close(self) -> None:
        """End the events of all current and later pages."""
        with self.changed:
            self.closed = True
            self.changed.notify_all()


def encode_event(name: str, value: Mapping[str, Any]) -> bytes:
    return f"event: {name}\ndata: {json.dumps(value, separators=(',', ':'))}\n\n".encode()


class LiveHandler(PageHandler):
    """Answers one request from a page."""

    server: LiveServer

    def answer(self, path: str, query: Mapping[str, str]) -> None:
        name = path or "index.html"
        if name == "events":
            self.send_events(self.server.hub.stream_events())
        elif name in self.server.files:
            self.send(200, find_content_type(name), self.server.files[name])
        else:
            self.send(404, TEXT, b"not found")

    def do_POST(self) -> None:
        """Receive a command from the page. The answer is empty, or an error message."""
        take, code, line = self.server.take_command, 200, ""
        with contextlib.suppress(ConnectionError, TimeoutError):
            if not self.server.access.allows_change(self.path, self.headers, self.server.server_port):
                code = 403
            elif self.path != "/wearer" or take is None:
                code = 404
            else:
                try:
                    take(json.loads(self.body))
                except (ValueError, RecursionError) as error:
                    code, line = 400, str(error) if isinstance(error, InputError) else "not JSON"
            self.send(code, TEXT, line.encode())


class LiveServer(PageServer):
    """Serves the live page with files by name (see `PageServer`). `hub` sends the frames. `take_command`
    processes a command from the page, or raises InputError; None rejects all commands."""

    def __init__(
        self,
        hub: Hub,
        port: int,
        host: str = HOST,
        token: str | None = None,
        files: Mapping[str, bytes] | None = None,
        take_command: Callable[[object], None] | None = None,
    ):
        self.hub, self.files, self.take_command = hub, files or load_page_files(), take_command
        super().__init__(LiveHandler, port, host, token)

    def end_events(self) -> None:
        self.hub.close()
