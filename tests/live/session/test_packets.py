"""JSON and OSC packets: written and read again, and whatever else may arrive at the port."""

from __future__ import annotations

import contextlib
import json
import math
import sys

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from memmlp.common.errors import InputError
from memmlp.live.session.sources import Packet, from_json, from_osc, require_osc, to_json, to_osc

KINDS = {"json": (to_json, from_json), "osc": (to_osc, from_osc)}
POSE = (np.array([0.5, -1.25, 1.75]), np.array([0.5, 0.5, -0.5, 0.5]))
WHOLE = Packet((POSE, None, POSE), 12.25, 735)

kinds = pytest.mark.parametrize("kind", KINDS)


@kinds
@pytest.mark.parametrize("packet", [WHOLE, Packet((POSE, POSE, POSE)), Packet((None, POSE, None), 3.0)])
def test_there_and_back(kind: str, packet: Packet):
    there, back = KINDS[kind]
    again = back(there(packet))
    assert (again.time, again.seq) == (packet.time, packet.seq)
    for a, b in zip(again.trackers, packet.trackers, strict=True):
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            assert np.allclose(np.concatenate(a), np.concatenate(b), atol=1e-6)


def test_the_documented_json():
    text = b'{"time": 12.25, "head": [0, 1.6, 0, 0, 0, 0, 1], "left": null}'
    packet = from_json(text)
    assert packet.time == 12.25
    assert packet.trackers[0][0].tolist() == [0, 1.6, 0]
    assert packet.trackers[0][1].tolist() == [0, 0, 0, 1]
    assert packet.trackers[1:] == (None, None)


def test_the_documented_osc():
    data = to_osc(Packet((POSE, None, None), 2.5, 7))
    assert data.startswith(b"#bundle\0")
    for part in (b"/memmlp/head\0", b",fffffff\0", b"/memmlp/time\0", b",d\0", b"/memmlp/seq\0", b",i\0"):
        assert part in data
    assert b"left" not in data


HEAD = [0, 0, 0, 0, 0, 0, 1]


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"time": 1.0},
        {"head": 5},
        {"head": "0000001"},
        {"head": HEAD[:6]},
        {"head": [*HEAD[:6], "1"]},
        {"head": [*HEAD[:6], True]},
        {"head": [math.nan, *HEAD[1:]]},
        {"head": [math.inf, *HEAD[1:]]},
        {"head": [1e7, *HEAD[1:]]},
        {"head": [10**400, *HEAD[1:]]},
        {"head": [0] * 7},
        {"head": [0, 0, 0, 0, 0, 0, 2]},
        {"head": HEAD, "time": "now"},
        {"head": HEAD, "time": math.inf},
        {"head": HEAD, "time": True},
        {"head": HEAD, "seq": 1.5},
        [HEAD],
        None,
    ],
)
def test_what_is_no_packet(fields):
    with pytest.raises(ValueError, match=r"."):
        from_json(json.dumps(fields).encode())


@given(st.binary(max_size=200))
@example(b"[" * 60_000)
@example(b"\xff")
@example(b"#bundle\0" + b"\0" * 8 + b"\xff\xff\xff\xff")
def test_any_bytes_are_a_packet_or_refused(data: bytes):
    for _, back in KINDS.values():
        with contextlib.suppress(ValueError):
            assert isinstance(back(data), Packet)


@kinds
@given(place=st.integers(0, 10**6), byte=st.integers(0, 255), cut=st.booleans())
def test_damaged_packets_are_a_packet_or_refused(kind: str, place: int, byte: int, cut: bool):
    there, back = KINDS[kind]
    data = bytearray(there(WHOLE))
    place %= len(data)
    data[place] = byte
    try:
        packet = back(bytes(data[:place] if cut else data))
    except ValueError:
        return
    for tracker in packet.trackers:
        assert tracker is None or np.isfinite(np.concatenate(tracker)).all()


def test_without_python_osc_a_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pythonosc", None)
    with pytest.raises(InputError, match=r"pip install 'memmlp\[osc\]'"):
        require_osc()
