"""The page's server, with plain HTTP clients."""

import http.client
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest
from processes import PATIENCE

from memmlp.common.errors import InputError
from memmlp.live.session.loop import make_greeting
from memmlp.live.session.server import QUEUED, Hub, LiveServer, load_page_files, read_vrm
from memmlp.live.session.sources import ClipSource, TrackedClip
from memmlp.motion.body import make_builtin_rest_joints
from memmlp.motion.formats.gltf import encode_vrm


@pytest.fixture
def server(clip: TrackedClip) -> Iterator[LiveServer]:
    with LiveServer(Hub(make_greeting(ClipSource(clip, 60), "tiny")), 0) as server:
        yield server


def request(server: LiveServer, method: str, path: str, content: bytes | None = None, **headers: str):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=PATIENCE)
    connection.request(method, path, content, {name.replace("_", "-"): v for name, v in headers.items()})
    return connection.getresponse()


def get(server: LiveServer, path: str, **headers: str) -> http.client.HTTPResponse:
    return request(server, "GET", path, **headers)


def events(response: http.client.HTTPResponse) -> Iterator[tuple[str, dict]]:
    name = ""
    for line in response:
        key, _, value = line.decode().strip().partition(": ")
        if key == "event":
            name = value
        elif key == "data":
            yield name, json.loads(value)


def test_two_watchers_get_all_frames(server: LiveServer):
    streams = [events(get(server, "/events")) for _ in range(2)]
    for stream in streams:
        name, words = next(stream)
        assert (name, words["network"], words["source"]) == ("greeting", "tiny", "person at 60 Hz")
        assert len(words["limbs"]) == 24
    for number in range(5):
        server.hub.publish({"number": number})
    for stream in streams:
        assert [next(stream)[1]["number"] for _ in range(5)] == list(range(5))
    server.hub.close()
    assert [list(stream) for stream in streams] == [[], []]


def test_a_slow_page_loses_the_oldest_frames_and_no_state():
    hub = Hub({})
    hub.publish_state("wearer", {"height": 170})
    hub.publish_state("wearer", {"height": 180})
    slow = hub.stream_events()
    assert next(slow).split(b"\n\n")[1] == b'event: wearer\ndata: {"height":180}'  # the newest state
    hub.publish_state("wearer", {"calibrated": True})
    for number in range(QUEUED + 2):
        hub.publish({"number": number})
    state, *frames = next(slow).removesuffix(b"\n\n").split(b"\n\n")
    assert b"calibrated" in state
    assert [json.loads(frame.split(b"data: ")[1])["number"] for frame in frames] == [*range(2, QUEUED + 2)]


def test_the_pages_files_are_served_and_nothing_else(server: LiveServer):
    types = {"js": "text/javascript", "css": "text/css", "html": "text/html"}
    for name, content in load_page_files().items():
        response = get(server, f"/{name}")
        kind = f"{types[name.rsplit('.')[-1]]}; charset=utf-8"
        assert (response.status, response.headers["Content-Type"]) == (200, kind), name
        assert response.read() == content
        if not name.startswith("three/"):  # the page loads nothing from elsewhere
            assert b"//" not in content.replace(b"// ", b""), name
            assert b"npm" not in content or name == "avatar.js"
    assert get(server, "/").read() == load_page_files()["index.html"]
    for path in ("/../server.py", "/three/LICENSE/..", "/%2e%2e/server.py", "/main"):
        assert get(server, path).status == 404
    # A page of another site, whose name was made to mean this machine, gets nothing.
    assert get(server, "/events", Host=f"elsewhere.example:{server.server_port}").status == 403


def post(server: LiveServer, content: bytes, path: str = "/wearer", **headers: str) -> tuple[int, str]:
    response = request(server, "POST", path, content, **headers)
    return response.status, response.read().decode()


def test_commands_of_the_page_arrive():
    ask = Mock(side_effect=[None, InputError("no: not allowed")])
    with LiveServer(Hub({}), 0, take_command=ask) as server:
        command, own = {"action": "forget"}, f"http://127.0.0.1:{server.server_port}"
        assert post(server, json.dumps(command).encode(), Origin=own) == (200, "")
        ask.assert_called_once_with(command)
        assert post(server, b'"no"') == (400, "no: not allowed")
        for content in (b"", b"nonsense", b"[" * 900, b"\xff"):
            assert post(server, content) == (400, "not JSON")
        assert post(server, b"{}", "/other")[0] == 404
        elsewhere = {"Origin": "http://elsewhere.example", "Host": "elsewhere.example"}
        for name, value in {**elsewhere, "Sec_Fetch_Site": "cross-site"}.items():
            assert post(server, b"{}", **{name: value})[0] == 403, name
    assert ask.call_count == 2


def vrm(content: object) -> bytes:
    text = json.dumps(content).encode()
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text


def test_files_without_an_avatar_are_rejected(tmp_path: Path):
    mannequin = encode_vrm(make_builtin_rest_joints())
    for name, content in (("own", mannequin), ("old", vrm({"extensions": {"VRM": {}}}))):
        (tmp_path / name).write_bytes(content)
        assert read_vrm(tmp_path / name) == content
    others = {"text": b"nothing", "short": b"glTF", "cut": mannequin[:100], "plain": vrm({}), "list": vrm([])}
    for name, content in others.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=name):
            read_vrm(tmp_path / name)
    with pytest.raises(InputError, match="missing"):
        read_vrm(tmp_path / "missing")
