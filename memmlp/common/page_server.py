"""The HTTP server of a local page: access control, files and events.

At the loopback address, the Host header of a request must name that address; this prevents DNS rebinding.
At any other address, each request needs the token. The printed address contains the token; the server then
moves it to a cookie, to keep it out of the browser's history. Requests from pages of other sites are refused,
except for links to the page. These rules come before everything else.

The number of connections is limited, and so is that of threads. At the limit, a new connection closes the one
that has waited longest for a request. So clients that send slowly or nothing do not delay others.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import math
import re
import secrets
import socket
import threading
import time
import urllib.parse
from collections.abc import Iterable, Mapping
from email.message import Message
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from ipaddress import ip_address
from typing import Any, Self

from memmlp.common.errors import InputError

HOST, EVERYWHERE = "127.0.0.1", "0.0.0.0"
COOKIE = "memmlp_token"
MIN_LENGTH = 16  # characters of a token
MAX_CONNECTIONS, MAX_STREAMS = 100, 50  # open connections, and those of them with events
MAX_BODY = 1000  # bytes of a request's body
MAX_WAIT = 10.0  # seconds for a request to arrive completely
MAX_SEND_WAIT = 60  # seconds without progress while an answer is sent
TEXT = "text/plain; charset=utf-8"
TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css", "vrm": "model/gltf-binary"}


def read_page_file(package: str, name: str) -> bytes:
    """Return the content of a file in the folder `page` of a package."""
    return resources.files(package).joinpath("page", *name.split("/")).read_bytes()


def find_content_type(name: str) -> str:
    """Return the content type for a file name."""
    return f"{TYPES[name.rsplit('.', 1)[-1]]}; charset=utf-8"


def build_security_policy(index: str, *scripts: str) -> str:
    """Return a page's Content-Security-Policy; it allows only the page's own scripts, the import map in its
    HTML `index`, and further sources of `scripts`."""
    inline = re.search(r'<script type="importmap">(.*?)</script>', index, re.DOTALL)
    assert inline is not None
    digest = base64.b64encode(hashlib.sha256(inline[1].encode()).digest()).decode()
    sources = " ".join(["'self'", *scripts, f"'sha256-{digest}'"])
    return (
        f"default-src 'none'; script-src {sources}; worker-src 'self'; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'"
    )


class AccessRules:
    """The access rules of a server that listens at `host`. Its `token` is None at the loopback address, else
    the given one or a new random one."""

    def __init__(self, host: str, token: str | None = None):
        self.host = host
        self.token = None if is_loopback(host) else token or secrets.token_urlsafe(24)

    def allows(self, path: str, headers: Message, port: int) -> bool:
        """Return whether a request may be answered, judging by its host, origin and token."""
        url = urllib.parse.urlsplit(path)
        if self.token is None:
            hosts = [re.sub(":[0-9]+$", "", host) for host in headers.get_all("Host", [])]
            if hosts not in ([HOST], ["localhost"], [self.host]):
                return False
        else:
            given = dict(urllib.parse.parse_qsl(url.query)).get("token", "") or _read_cookie(headers, port)
            if not secrets.compare_digest(given.encode(), self.token.encode()):
                return False
        is_link = headers.get("Sec-Fetch-Mode") == "navigate" and url.path == "/"
        return is_link or headers.get("Sec-Fetch-Site", "none") in ("none", "same-origin")

    def allows_change(self, path: str, headers: Message, port: int) -> bool:
        """Return whether a request may change data; requests from pages of other sites may not."""
        origin = headers.get("Origin")  # browsers send it with every POST
        return origin in (None, f"http://{headers.get('Host', '')}") and self.allows(path, headers, port)


def is_loopback(host: str) -> bool:
    """Return whether an address is 127.0.0.1 or localhost; other machines can't connect to it."""
    try:
        return host == "localhost" or (ip_address(host).is_loopback and ip_address(host).version == 4)
    except ValueError:
        return False


def check_token(host: str, token: str | None) -> None:
    """Raise InputError if a token is too short, or if the address does not need a token."""
    if token is not None and is_loopback(host):
        raise InputError("--token: must not be set for the loopback address; set --host too, or drop --token")
    if token is not None and len(token) < MIN_LENGTH:
        raise InputError(f"--token: must have at least {MIN_LENGTH} characters")


def _read_cookie(headers: Message, port: int) -> str:
    try:
        cookie = SimpleCookie(headers.get("Cookie", "")).get(f"{COOKIE}_{port}")
    except CookieError:
        return ""
    return urllib.parse.unquote(cookie.value) if cookie else ""


class PageHandler(BaseHTTPRequestHandler):
    """Answers one request of a page; subclasses define `answer`."""

    server: PageServer
    timeout = MAX_SEND_WAIT
    max_body = MAX_BODY
    body: bytes

    def handle_one_request(self) -> None:
        """Wait for a request, and answer it."""
        self.server.set_waiting(self.connection, time.monotonic())
        super().handle_one_request()

    def parse_request(self) -> bool:
        """Read a request, and return whether it may be answered; otherwise, send the reason."""
        if not super().parse_request():
            return False
        access, port = self.server.access, self.server.server_port
        chunked, length = "Transfer-Encoding" in self.headers, self.headers.get("Content-Length", "0")
        if not access.allows(self.path, self.headers, port):
            return self._refuse(403, "access denied; open the address that the command printed")
        if chunked or not re.fullmatch(r"[0-9]+", length):
            return self._refuse(411, "Content-Length: must be a number of bytes")
        if len(length) > 9 or int(length) > self.max_body:
            return self._refuse(413, f"Content-Length: must be at most {self.max_body}")
        self.body = self.rfile.read(int(length))
        self.server.set_waiting(self.connection, math.inf)
        return True

    def _refuse(self, code: int, reason: str) -> bool:
        self.close_connection = True
        self.send(code, TEXT, f"{reason}\n".encode())
        return False

    def answer(self, path: str, query: Mapping[str, str]) -> None:
        """Send the answer to an allowed GET request; `path` does not begin with a slash."""
        raise NotImplementedError

    def do_GET(self) -> None:
        """Answer the request, or move its token to a cookie."""
        with contextlib.suppress(ConnectionError, TimeoutError):  # raised when the page was closed
            url, port = urllib.parse.urlsplit(self.path), self.server.server_port
            query = dict(urllib.parse.parse_qsl(url.query))
            if "token" in query:
                cookie = f"{COOKIE}_{port}={urllib.parse.quote(query['token'])}"
                headers = {"Set-Cookie": f"{cookie}; HttpOnly; SameSite=Strict; Path=/", "Location": "/"}
                if self.headers.get("Sec-Fetch-Site") == "cross-site":  # its redirect would have no cookie
                    self.send(200, TEXT, b"", headers | {"Refresh": "0; url=/"})
                else:
                    self.send(303, TEXT, b"", headers)
            else:
                self.answer(urllib.parse.unquote(url.path).lstrip("/"), query)

    def send(self, code: int, kind: str, content: bytes, headers: Mapping[str, str] | None = None) -> None:
        """Send an answer; `kind` is its content type."""
        self._send_head(code, kind, {"Content-Length": str(len(content)), **(headers or {})})
        self.wfile.write(content)

    def send_events(self, events: Iterable[bytes]) -> None:
        """Send server-sent events one by one, until the events end or the page is closed."""
        self.close_connection = True
        if not self.server.streams.acquire(blocking=False):
            return self.send(503, TEXT, b"too many open pages; close some\n")
        try:
            self._send_head(200, "text/event-stream", {"Connection": "close"})
            for event in events:
                self.wfile.write(event)
        finally:
            self.server.streams.release()

    def _send_head(self, code: int, kind: str, headers: Mapping[str, str]) -> None:
        self.send_response(code)
        safe = {
            "Content-Type": kind,
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
        }
        for name, value in (safe | dict(self.server.headers) | dict(headers)).items():
            self.send_header(name, value)
        self.end_headers()

    def version_string(self) -> str:
        """Return the name of the server."""
        return "memmlp"

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""


class PageServer(ThreadingHTTPServer):
    """Serves a page in background threads, inside a `with` block. `handler` is the class that answers
    requests. Port 0 is any free port. At the host 127.0.0.1, only this machine can open the page; other
    addresses need `token`, None for a new random one. `headers` come with every answer. Raises InputError if
    the address does not belong to this machine, or the port is in use."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 128
    headers: Mapping[str, str] = {}

    def __init__(
        self, handler: type[PageHandler], port: int, host: str = HOST, token: str | None = None
    ) -> None:
        self.access = AccessRules(host, token)
        self.lock, self.streams = threading.Lock(), threading.Semaphore(MAX_STREAMS)
        self.waiting: dict[Any, float] = {}  # open connections, and since when each waits for a request
        try:
            super().__init__((host, port), handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            expected = "must be an address of this machine and a free port (0 for any)"
            raise InputError(f"--host {host} --port {port}: {reason}; {expected}") from None

    def server_bind(self) -> None:
        """Bind to the address without a name lookup, even if a page of an earlier server is still open."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = name, port, *_ = self.socket.getsockname()
        self.server_name, self.server_port = name, port

    @property
    def url(self) -> str:
        """The page's address, with the token if one is needed; for a server at all addresses, that for other
        machines."""
        name = find_own_address() if self.server_name == EVERYWHERE else self.server_name
        token = self.access.token
        return f"http://{name}:{self.server_port}/" + (f"?token={urllib.parse.quote(token)}" if token else "")

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start a thread for a connection. At the limit, close the connection that waits longest, or this."""
        with self.lock:
            full = len(self.waiting) >= MAX_CONNECTIONS
            if full and self.waiting[oldest := min(self.waiting, key=self.waiting.__getitem__)] < math.inf:
                self._close_connection(oldest)
                full = False
            if not full:
                self.waiting[request] = time.monotonic()
        if full:
            self.shutdown_request(request)
        else:
            super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection at the end of its thread."""
        with self.lock:
            self.waiting.pop(request, None)
        super().shutdown_request(request)

    def set_waiting(self, connection: Any, since: float) -> None:
        """Record since when a connection waits for a request; infinity while it is answered."""
        with self.lock:
            if connection in self.waiting:
                self.waiting[connection] = since

    def service_actions(self) -> None:
        """Close connections whose requests take too long to arrive; called several times a second."""
        with self.lock:
            for connection, since in list(self.waiting.items()):
                if since < time.monotonic() - MAX_WAIT:
                    self._close_connection(connection)

    def _close_connection(self, connection: Any) -> None:
        del self.waiting[connection]
        with contextlib.suppress(OSError):  # raised if its thread closed it
            connection.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore the error: an interrupted request does not affect other pages."""

    def end_events(self) -> None:
        """End the event streams of all pages; this is called before the server stops."""

    def __enter__(self) -> Self:
        self.thread = threading.Thread(target=self.serve_forever, args=(0.05,), daemon=True)
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end_events()
        self.shutdown()
        self.thread.join()
        self.server_close()


def find_own_address() -> str:
    """Return the address at which other machines can reach this one; no data is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address for documentation (RFC 5737)
        except OSError:
            return socket.gethostname()
        return str(probe.getsockname()[0])
