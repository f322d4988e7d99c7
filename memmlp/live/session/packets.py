"""Packets of tracker poses: one datagram is one sample, as JSON or as an OSC bundle.

A pose is seven numbers, `x y z qx qy qz qw`: metres and a unit quaternion. In JSON:

    {"time": 12.25, "seq": 735, "head": [x, y, z, qx, qy, qz, qw], "left": null, "right": [...]}

In OSC a bundle has the messages `/memmlp/head`, `/memmlp/left`, `/memmlp/right` (seven floats each),
`/memmlp/time` (a double or float) and `/memmlp/seq` (an integer).

A tracker that is null or missing is lost. A packet without a time gets its time of arrival. By the sample's
number, seq, missing packets are counted, and those that others have overtaken are left out.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from memmlp.common.errors import InputError
from memmlp.live.tracker_resampling import TRACKERS

POSE = 7  # numbers of a pose
PREFIX = "/memmlp/"
FARTHEST = 1e6  # the largest absolute value of a number in a pose

QuaternionPose = tuple[np.ndarray, np.ndarray] | None
"""A tracker's position (3,), metres, and quaternion xyzw (4,); None for a lost tracker."""
QuaternionPoses = tuple[QuaternionPose, QuaternionPose, QuaternionPose]
"""The poses of head, left and right."""


class Packet(NamedTuple):
    """One sample of the trackers.

    Attributes:
        trackers: head, left and right.
        time: seconds of the sender's clock; None if the packet has no time.
        seq: the sample's number; None if the packet has none.
    """

    trackers: QuaternionPoses
    time: float | None = None
    seq: int | None = None


Parse = Callable[[bytes], Packet]


def from_json(datagram: bytes) -> Packet:
    """Read the packet of a JSON datagram. Raises ValueError for anything else."""
    try:
        fields = json.loads(datagram)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(fields, dict):
        raise ValueError("no JSON object")
    return packet(fields)


def to_json(packet: Packet) -> bytes:
    """Return the JSON datagram of a packet."""
    return json.dumps(_fields(packet)).encode()


def from_osc(datagram: bytes) -> Packet:
    """Read the packet of an OSC bundle. Raises ValueError for anything else."""
    from pythonosc.osc_bundle import OscBundle
    from pythonosc.osc_message import OscMessage

    logging.disable(logging.WARNING)  # the library warns of each datagram that it can't read
    try:
        parts = [part for part in OscBundle(datagram) if isinstance(part, OscMessage)]
        arguments = {part.address.removeprefix(PREFIX): list(part.params) for part in parts}
    except Exception as error:  # the library raises many kinds over bytes that are no OSC
        raise ValueError(f"no OSC bundle ({error})") from None
    finally:
        logging.disable(logging.NOTSET)
    numbers = {key: arguments[key][0] for key in ("time", "seq") if arguments.get(key)}
    return packet(arguments | numbers)


def to_osc(packet: Packet) -> bytes:
    """Return the OSC bundle of a packet."""
    from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
    from pythonosc.osc_message_builder import OscMessageBuilder

    bundle = OscBundleBuilder(IMMEDIATELY)
    for name, value in _fields(packet).items():
        if value is None:
            continue
        message = OscMessageBuilder(PREFIX + name)
        for number in value if isinstance(value, list) else [value]:
            message.add_arg(number, {"time": "d", "seq": "i"}.get(name, "f"))
        bundle.add_content(message.build())
    return bundle.build().dgram


def packet(fields: Mapping[str, Any]) -> Packet:
    """Return the packet with named values. Raises ValueError if the values are no packet."""
    if not any(name in fields for name in TRACKERS):
        raise ValueError(f"none of {', '.join(TRACKERS)}")
    time, seq = fields.get("time"), fields.get("seq")
    if time is not None and not _number(time):
        raise ValueError("time: no number")
    if seq is not None and (not isinstance(seq, int) or isinstance(seq, bool)):
        raise ValueError("seq: no integer")
    head, left, right = (_tracker(name, fields.get(name)) for name in TRACKERS)
    return Packet((head, left, right), time, seq)


def needs_osc(option: str = "--osc", instead: str = "--udp") -> None:
    """Raise InputError if python-osc, which an option needs, is not installed."""
    if find_spec("pythonosc") is None:
        raise InputError(f"{option}: needs python-osc, pip install 'memmlp[osc]'; allowed without: {instead}")


def _tracker(name: str, values: Any) -> QuaternionPose:
    """Return a tracker from its seven numbers. Raises ValueError if they are no pose."""
    if values is None:
        return None
    if not isinstance(values, list) or len(values) != POSE or not all(map(_number, values)):
        raise ValueError(f"{name}: not {POSE} numbers")
    pose = np.array(values, np.float64)
    norm = float(np.linalg.norm(pose[3:]))
    if np.abs(pose).max() > FARTHEST or abs(norm - 1) > 1e-2:
        raise ValueError(f"{name}: no pose")
    return pose[:3], pose[3:] / norm


def _number(value: Any) -> bool:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return abs(value) < 1e300 and math.isfinite(value)


def _fields(packet: Packet) -> dict[str, Any]:
    poses = [None if t is None else [float(v) for part in t for v in part] for t in packet.trackers]
    return {"time": packet.time, "seq": packet.seq, **dict(zip(TRACKERS, poses, strict=True))}
