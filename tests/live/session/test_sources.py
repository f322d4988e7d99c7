"""Packets, whatever else arrives at the port, and clips in real time, by a clock of the tests' own."""

import contextlib
import json
import math
import socket
from ipaddress import IPv4Network
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from live.session.conftest import PERSON
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.common.progress import print_announcements
from memmlp.live.outputs import encode_osc
from memmlp.live.rotations import quaternion_to_matrix
from memmlp.live.session.sources import (
    HOST,
    PAUSE,
    ClipSource,
    Packet,
    PacketSource,
    TrackedClip,
    parse_json_packet,
    parse_osc_packet,
    read_npz_frames,
)
from memmlp.live.tracker_input import TrackerReader
from memmlp.live.tracker_resampling import TRACKERS
from memmlp.motion.body import SPARSE_POSITION, SPARSE_ROTATION, make_builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.formats.npz import write_clip

POSE = (np.array([0.5, -1.25, 1.75]), np.array([0.5, 0.5, -0.5, 0.5]))
WHOLE = Packet((POSE, None, POSE), 12.25, 735)


def to_osc(packet: Packet) -> bytes:
    kinds = {"time": "d", "seq": "i"}
    return encode_osc(
        (f"/memmlp/{name}", kinds.get(name, "fffffff"), np.atleast_1d(value).tolist())
        for name, value in fields(packet).items()
        if value is not None
    )


def fields(packet: Packet) -> dict[str, Any]:
    poses = [pose and np.concatenate(pose).tolist() for pose in packet.trackers]
    return {"time": packet.time, "seq": packet.seq, **dict(zip(TRACKERS, poses, strict=True))}


KINDS = {
    "json": (lambda packet: json.dumps(fields(packet)).encode(), parse_json_packet),
    "osc": (to_osc, parse_osc_packet),
}
kinds = pytest.mark.parametrize("kind", KINDS)


@kinds
@pytest.mark.parametrize("packet", [WHOLE, Packet((POSE, POSE, POSE)), Packet((None, POSE, None), 3.0)])
def test_the_documented_formats(kind: str, packet: Packet):
    there, back = KINDS[kind]
    again = back(there(packet))
    assert (again.time, again.seq) == (packet.time, packet.seq)
    for a, b in zip(again.trackers, packet.trackers, strict=True):
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            assert np.allclose(np.concatenate(a), np.concatenate(b), atol=1e-6)


HEAD = [0, 0, 0, 0, 0, 0, 1]


@kinds
@pytest.mark.parametrize("left", [None, [0] * 7, [math.nan] * 7, [], False])
def test_a_lost_hand_leaves_the_packet_s_other_trackers(kind: str, left: Any):
    _, back = KINDS[kind]
    given = {"head": [0, 1.6, 0, 0, 0, 0, 1], "left": left, "right": [0.7, 1.4, 0, 0, 0, 0, 1]}
    text = encode_osc((f"/memmlp/{key}", "f" * len(v or ()), map(float, v or ())) for key, v in given.items())
    packet = back(text if kind == "osc" else json.dumps(given).encode())
    assert TrackerReader(60).read(packet.trackers)[2] == (False, True, False)


@pytest.mark.parametrize("value", [0.0, math.nan])
def test_a_clip_s_lost_hand_is_lost_between_its_frames_too(value: float):
    frames = PERSON.frames.numpy().copy()
    frames[10:15, SPARSE_POSITION][:, 3:6] = value
    frames[30:35, SPARSE_ROTATION][:, 6:12] = value
    clip = TrackedClip("person", frames)
    for frame in np.arange(5.1, 40, 0.4):
        lost = TrackerReader(60).read(clip.interpolate_trackers(frame / 60))[2]
        assert lost == (False, any(first - 1 < frame < first + 5 for first in (10, 30)), False), frame


def test_bad_packets_are_rejected():
    heads = [5, "0000001", HEAD[:6], [10**400, *HEAD[1:]]]
    wholes = [{}, {"time": 1.0}, [HEAD], None, {"head": HEAD, "seq": 1.5}]
    for fields in (*wholes, *({"head": head} for head in heads)):
        with pytest.raises(InputError):
            parse_json_packet(json.dumps(fields).encode())


@given(st.binary(max_size=200))
@example(b"[" * 60_000)
@example(b"\xff")
@example(b"#bundle\0" + b"\0" * 8 + b"\xff\xff\xff\xff")
def test_any_bytes_are_a_packet_or_rejected(data: bytes):
    for _, back in KINDS.values():
        with contextlib.suppress(InputError):
            assert isinstance(back(data), Packet)


class Clock:
    """A clock that advances when somebody sleeps or works."""

    now = 100.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0
        self.now += seconds


def source(clip: TrackedClip, hz: float, clock: Clock) -> ClipSource:
    return ClipSource(clip, hz, clock, clock.sleep)


@pytest.mark.parametrize(("hz", "count"), [(60, 120), (72, 143), (90, 179)])
def test_a_clip_comes_at_its_rate(clip: TrackedClip, hz: float, count: int):
    clock = Clock()
    played = source(clip, hz, clock)
    assert played.count == count
    samples = [(clock.now, played.read()) for _ in range(count)]
    assert clock.now - 100 == pytest.approx((count - 1) / hz)
    assert [s.time for _, s in samples] == pytest.approx([i / hz for i in range(count)])
    assert all(s.dropped == 0 for _, s in samples)


def test_samples_are_the_clips_frames_or_between_them(clip: TrackedClip):
    for index in (0, 7, 119):
        position, quaternion = clip.interpolate_trackers(index / 60)[1]
        np.testing.assert_allclose(position, clip.positions[index, 1], atol=1e-9)
        np.testing.assert_allclose(quaternion_to_matrix(quaternion), clip.rotations[index, 1], atol=1e-6)
        np.testing.assert_allclose(clip.interpolate_joints(index / 60), clip.joints[index], atol=1e-9)
    position, quaternion = clip.interpolate_trackers(10.5 / 60)[2]
    np.testing.assert_allclose(position, clip.positions[10:12, 2].mean(0), atol=1e-9)
    turns = Rotation.from_matrix(clip.rotations[10:12, 2])
    halfway = turns[0] * Rotation.from_rotvec((turns[0].inv() * turns[1]).as_rotvec() / 2)
    np.testing.assert_allclose(quaternion_to_matrix(quaternion), halfway.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(clip.interpolate_joints(10.5 / 60), clip.joints[10:12].mean(0), atol=1e-9)


@pytest.mark.parametrize("hz", [50.0, 72.0])
def test_rounds_follow_after_pauses_with_the_truth_of_the_first(clip: TrackedClip, hz: float):
    """A round's beginning is a multiple of its length but for rounding, and may lie before it."""
    played = source(clip, hz, Clock())
    samples = [played.read() for _ in range(played.count + 1)]
    assert samples[-1].time - samples[-2].time == pytest.approx(PAUSE)
    assert np.array_equal(samples[-1].trackers[0][0], samples[0].trackers[0][0])
    for turn in range(1, 200):
        for step in (0, 1, played.count - 1):
            truth = played.get_true_joints(turn * played.round_seconds + step / hz)
            np.testing.assert_allclose(truth, clip.interpolate_joints(step / hz), atol=1e-6)


def received(*numbers: int) -> list[int | None]:
    """How many packets were missing before each packet; None for one that is left out."""
    source = PacketSource("JSON", 0, parse_json_packet, "openxr")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"nonsense", (HOST, source.port))
        for seq in numbers:
            sender.sendto(json.dumps({"head": HEAD, "seq": seq}).encode(), (HOST, source.port))
    with pytest.raises(InputError):
        source.read()
    samples = [source.read() for _ in numbers]
    assert source.read() is None
    source.close()
    return [sample and sample.dropped for sample in samples]


def test_missing_and_overtaken_packets_are_counted():
    """Without times an overtaken packet's pose would count as the newest. A far lower number is a restart."""
    assert received(100, 103, 102, 101, 103, 104, 0, 1) == [0, 2, None, None, 0, 0, 0, 0]
    assert received(4, 8, -40, 10**300) == [0, 3, 0, 0]


def test_only_listed_machines_packets_are_accepted():
    lines: list[str] = []
    senders = [IPv4Network("192.168.1.9"), IPv4Network("10.0.0.0/8")]
    arrives = PacketSource("UDP", 0, parse_json_packet, "amass", senders, lines.append)
    assert arrives.socket.getsockname()[0] == "0.0.0.0"
    arrives.close()
    taken, expected = {}, ["192.168.1.9", "10.3.2.1", "127.0.0.1"]
    for sender in (*expected, *5 * ["192.168.1.8"], *(f"8.8.8.{i}" for i in range(9))):
        data = b'{"head": [0, 0, 1.6, 0, 0, 0, 1]}'
        arrives.socket = Mock(**{"recvfrom.return_value": (data, (sender, 5000))})
        taken[sender] = arrives.read() is not None
    assert [sender for sender, is_taken in taken.items() if is_taken] == expected
    assert "--sender 192.168.1.8" in lines[0]
    assert len(lines) == 3  # a flood of them fills no screen


def test_only_this_machine_is_listened_to():
    arrives = PacketSource("UDP", 0, parse_json_packet, "amass")
    assert arrives.socket.getsockname()[0] == "127.0.0.1"
    with pytest.raises(InputError, match=f"port {arrives.port}: "):
        PacketSource("UDP", arrives.port, parse_json_packet, "amass")
    arrives.close()
    PacketSource("UDP", arrives.port, parse_json_packet, "amass").close()


def test_an_unusual_file_is_reported_and_a_short_one_rejected(tmp_path: Path, capsys):
    """Somebody who lies throughout, or a file with another axis up."""
    turns = 1e-3 * np.arange(5.0)[:, None, None] + np.zeros((5, 22, 3))
    write_clip(tmp_path / "a.npz", Clip("a", turns, np.zeros((5, 3)), 60.0))
    write_clip(tmp_path / "b.npz", Clip("b", turns[:2], np.zeros((2, 3)), 60.0))
    with print_announcements():
        assert len(read_npz_frames(tmp_path / "a.npz", make_builtin_rest_joints())) == 4
        with pytest.raises(InputError, match=r"b\.npz: has 2 frames"):
            read_npz_frames(tmp_path / "b.npz", make_builtin_rest_joints())
    assert capsys.readouterr().err.startswith(f"{tmp_path / 'a.npz'}: is unusual")
