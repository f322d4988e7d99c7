"""Who may ask a page's server and change something, and clients that are slow, many or hostile."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from email.message import Message
from urllib.parse import quote

import pytest
from processes import PATIENCE

from memmlp.common import page_server
from memmlp.common.errors import InputError
from memmlp.common.page_server import (
    COOKIE,
    MAX_BODY,
    TEXT,
    AccessRules,
    PageHandler,
    PageServer,
    check_token,
    find_own_address,
    is_loopback,
)

TOKEN = "a token of many letters"


def headers(**given: str) -> Message:
    """Headers of a request; _ stands for -."""
    made = Message()
    for name, value in given.items():
        made[name.replace("_", "-")] = value
    return made


@pytest.mark.parametrize(("host", "alone"), [
    ("127.0.0.1", True), ("localhost", True), ("127.0.0.2", True), ("0.0.0.0", False), ("::", False),
])  # fmt: skip
def test_which_addresses_are_this_machine_s_alone(host: str, alone: bool):
    assert is_loopback(host) is alone
    assert (AccessRules(host).token is None) is alone


@pytest.mark.parametrize(("given", "allowed"), [
    ({"Host": "127.0.0.1:8765"}, True), ({"Host": "localhost"}, True), ({}, False),
    ({"Host": "127.0.0.1.evil.example:80"}, False), ({"Host": "evil.example:8765"}, False),
    ({"Host": "localhost:80@evil.example"}, False),
    ({"Host": "localhost", "Sec_Fetch_Site": "cross-site"}, False),
    ({"Host": "localhost", "Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate"}, True),
    ({"Host": "evil.example", "Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate"}, False),
    ({"Host": "localhost", "Sec_Fetch_Site": "same-origin"}, True),
])  # fmt: skip
def test_this_machine_s_own_address(given: dict[str, str], allowed: bool):
    assert AccessRules("127.0.0.1").allows("/", headers(**given), 8765) is allowed


@pytest.mark.parametrize(("path", "cookie", "allowed"), [
    ("/", "", False), ("/?token=", "", False), ("/?token=wrong", "", False), ("/?token=%ff", "", False),
    (f"/?token={quote(TOKEN)}", "", True), ("/events", f"{COOKIE}_8765={quote(TOKEN)}", True),
    ("/events", f"{COOKIE}_1={quote(TOKEN)}", False), ("/events", f"{COOKIE}_8765=wrong", False),
])  # fmt: skip
def test_another_address_needs_the_token(path: str, cookie: str, allowed: bool):
    asked = headers(Host="192.168.1.5:8765", **({"Cookie": cookie} if cookie else {}))
    assert AccessRules("192.168.1.5", TOKEN).allows(path, asked, 8765) is allowed


@pytest.mark.parametrize(("origin", "allowed"), [
    (None, True), ("http://localhost:8765", True), ("http://localhost:8766", False), ("null", False),
])  # fmt: skip
def test_only_the_page_itself_changes_something(origin: str | None, allowed: bool):
    """A page of another site can send a form here, with the browser's cookies."""
    given = headers(Host="localhost:8765", **({"Origin": origin} if origin else {}))
    assert AccessRules("127.0.0.1").allows_change("/wearer", given, 8765) is allowed


@pytest.mark.parametrize(("host", "token"), [("127.0.0.1", TOKEN), ("0.0.0.0", "short")])
def test_a_token_that_makes_no_sense_is_one_line(host: str, token: str):
    with pytest.raises(InputError, match="--token: "):
        check_token(host, token)


class Handler(PageHandler):
    protocol_version = "HTTP/1.1"

    def answer(self, path: str, query: Mapping[str, str]) -> None:
        self.send(200, TEXT, b"here")

    def do_POST(self) -> None:
        self.send(200, TEXT, self.body)


@pytest.fixture
def server() -> Iterator[PageServer]:
    with PageServer(Handler, 0) as running:
        yield running


@contextlib.contextmanager
def connect(server: PageServer, content: bytes = b"") -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", server.server_port), PATIENCE) as client:
        client.sendall(content)
        yield client


def ask(server: PageServer, method: str = "GET", body: bytes = b"", **given: str) -> tuple[int, float]:
    """Return the status of the answer to a request, and the seconds until it came."""
    lines = [f"{name.replace('_', '-')}: {value}" for name, value in {"Host": "localhost", **given}.items()]
    begin = time.monotonic()
    with connect(server, "\r\n".join([f"{method} / HTTP/1.1", *lines, "", ""]).encode() + body) as client:
        return int(client.recv(1000).split()[1]), time.monotonic() - begin


def test_bodies_are_bounded(server: PageServer):
    accepted = dict.fromkeys((0, 4, MAX_BODY), 200)
    refused = {MAX_BODY + 1: 413, "9" * 5000: 413, -1: 411, "x": 411, "+4": 411, "": 411}
    for length, code in (accepted | refused).items():
        body = b"x" * (length if isinstance(length, int) and 0 < length <= MAX_BODY else 4)
        assert ask(server, "POST", body, Content_Length=str(length))[0] == code, length
    assert ask(server, "POST", b"4\r\nxxxx\r\n0\r\n\r\n", Transfer_Encoding="chunked")[0] == 411
    assert ask(server, "POST")[0] == 200
    evil = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"  # a body is not the next request
    with connect(
        server, b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n" % len(evil) + evil
    ) as client:
        client.settimeout(0.5)
        with contextlib.suppress(TimeoutError):
            assert client.recv(1000).count(b"HTTP/1.1") + client.recv(1000).count(b"HTTP/1.1") == 1


@pytest.mark.parametrize("method", ["GET", "POST", "HEAD", "PUT", "OPTIONS", "NONE"])
def test_the_host_comes_before_everything_else(server: PageServer, method: str):
    assert ask(server, method, Host="evil.example", Content_Length="-1")[0] == 403
    assert (
        ask(server, method, Host="evil.example", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate")[0]
        == 403
    )


def test_a_link_from_another_site_keeps_its_token():
    with PageServer(Handler, 0, "0.0.0.0", TOKEN) as server:
        link = "Sec-Fetch-Mode: navigate\r\nSec-Fetch-Site: cross-site"
        with connect(server, f"GET /?token={quote(TOKEN)} HTTP/1.1\r\n{link}\r\n\r\n".encode()) as client:
            answer = client.recv(1000)
        address = f"http://{find_own_address()}:{server.server_port}/?token="
        assert server.url.startswith(address), "others cannot open it"
    assert answer.startswith(b"HTTP/1.1 200")
    assert b"Refresh: 0; url=/" in answer
    assert b"SameSite=Strict" in answer


@pytest.mark.parametrize(
    "content", [b"", b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\nx"]
)
def test_sixty_slow_clients_do_not_delay_another(
    server: PageServer, monkeypatch: pytest.MonkeyPatch, content: bytes
):
    monkeypatch.setattr(page_server, "MAX_CONNECTIONS", 20)
    before = threading.active_count()
    with contextlib.ExitStack() as stack:
        slow = [stack.enter_context(connect(server, content)) for _ in range(60)]
        assert ask(server) == (200, pytest.approx(0, abs=1))
        assert len(server.waiting) <= 20
        while threading.active_count() > before + 20:
            time.sleep(0.01)
        assert slow[0].recv(10) == b""  # the oldest one was closed
        monkeypatch.setattr(page_server, "MAX_WAIT", 0.2)
        end = time.monotonic() + PATIENCE
        while server.waiting and time.monotonic() < end:
            with contextlib.suppress(OSError):
                slow[-1].sendall(b"x")  # a byte now and then does not keep it open
            time.sleep(0.05)
        assert not server.waiting


def test_open_pages_leave_room_for_other_requests(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(page_server, "MAX_STREAMS", 3)
    stopped = threading.Event()
    monkeypatch.setattr(
        Handler,
        "answer",
        lambda self, path, query: self.send_events(b"quiet" for _ in iter(lambda: stopped.wait(0.01), True)),
    )
    with PageServer(Handler, 0) as server, contextlib.ExitStack() as stack:
        request = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
        pages = [stack.enter_context(connect(server, request)) for _ in range(3)]
        assert all(b" 200 " in page.recv(100) for page in pages)
        assert ask(server)[0] == 503
        assert ask(server, "POST") == (200, pytest.approx(0, abs=1))
        stopped.set()
