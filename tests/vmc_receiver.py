"""A receiver of the VMC protocol, from its specification and that of OSC 1.0, without any library.

protocol.vmc.info/english: OSC over UDP, `/VMC/Ext/OK` (int){loaded} (int){calibration state} (int){mode},
`/VMC/Ext/T` (float), `/VMC/Ext/Root/Pos` and `/VMC/Ext/Bone/Pos` (string){name} and seven floats: position
and quaternion xyzw in the parent's frame, of Unity: left-handed, Y up, +Z forward. Names are HumanBodyBones'.
"""

from __future__ import annotations

import socket
import struct
from typing import NamedTuple

import numpy as np

TREE = {
    "Hips": None, "LeftUpperLeg": "Hips", "RightUpperLeg": "Hips", "LeftLowerLeg": "LeftUpperLeg",
    "RightLowerLeg": "RightUpperLeg", "LeftFoot": "LeftLowerLeg", "RightFoot": "RightLowerLeg",
    "LeftToes": "LeftFoot", "RightToes": "RightFoot",
    "Spine": "Hips", "Chest": "Spine", "UpperChest": "Chest",
    "Neck": "UpperChest", "Head": "Neck", "LeftShoulder": "UpperChest", "RightShoulder": "UpperChest",
    "LeftUpperArm": "LeftShoulder", "RightUpperArm": "RightShoulder", "LeftLowerArm": "LeftUpperArm",
    "RightLowerArm": "RightUpperArm", "LeftHand": "LeftLowerArm", "RightHand": "RightLowerArm",
}  # fmt: skip
"""Unity's humanoid bones and their parents."""


class Message(NamedTuple):
    address: str
    types: str
    values: list


def messages(datagram: bytes) -> list[Message]:
    """The messages of an OSC packet: one, or those of a bundle."""
    assert len(datagram) % 4 == 0
    if not datagram.startswith(b"#bundle\0"):
        return [message(datagram)]
    found, at = [], 16  # after the name and the time tag
    while at < len(datagram):
        (size,) = struct.unpack_from(">i", datagram, at)
        found += messages(datagram[at + 4 : at + 4 + size])
        at += 4 + size
    assert at == len(datagram)
    return found


def message(data: bytes) -> Message:
    """One message: address, type tags, arguments, each padded to four bytes."""
    address, at = text(data, 0)
    types, at = text(data, at)
    assert address.startswith("/")
    assert types.startswith(",")
    values: list = []
    for kind in types[1:]:
        if kind == "s":
            value, at = text(data, at)
        else:
            (value,) = struct.unpack_from({"i": ">i", "f": ">f"}[kind], data, at)
            at += 4
        values.append(value)
    assert at == len(data)
    return Message(address, types, values)


def text(data: bytes, at: int) -> tuple[str, int]:
    """The text at a place, and the place after it."""
    end = data.index(b"\0", at)
    after = end + 4 - end % 4
    assert data[end:after] == bytes(after - end)
    return data[at:end].decode(), after


class Marionette:
    """Listens at a UDP port of this machine, and poses a body by what comes."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(60)
        self.port = self.socket.getsockname()[1]
        self.bones: dict[str, np.ndarray] = {}
        self.root = np.array([0.0, 0, 0, 0, 0, 0, 1])
        self.time, self.loaded = 0.0, False

    def receive(self) -> list[Message]:
        """Wait for one datagram, and take what is in it."""
        found = messages(self.socket.recv(65_536))
        for each in found:
            self.take(each)
        return found

    def take(self, each: Message) -> None:
        if each.address == "/VMC/Ext/OK":
            assert each.types == ",iii"
            self.loaded = each.values[0] == 1
        elif each.address == "/VMC/Ext/T":
            assert each.types == ",f"
            self.time = each.values[0]
        elif each.address == "/VMC/Ext/Root/Pos":
            assert (each.types, each.values[0]) == (",sfffffff", "root")
            self.root = np.array(each.values[1:])
        elif each.address == "/VMC/Ext/Bone/Pos":
            assert each.types == ",sfffffff"
            assert each.values[0] in TREE
            self.bones[each.values[0]] = np.array(each.values[1:])

    def positions(self) -> dict[str, np.ndarray]:
        """Where the bones are, in Unity's world."""
        return posed(self.root, self.bones)

    def close(self) -> None:
        self.socket.close()


def posed(root: np.ndarray, bones: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Where bones (..., 7) are in Unity's world (..., 3), below a root (..., 7)."""
    place = {None: (root[..., :3], root[..., 3:])}
    for name, above in TREE.items():
        (at, turned), bone = place[above], bones[name]
        place[name] = at + rotated(turned, bone[..., :3]), multiplied(turned, bone[..., 3:])
    return {name: at for name, (at, _) in place.items() if name}


def multiplied(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The products of quaternions xyzw (..., 4), as Unity's `a * b`."""
    v, w = a[..., :3], a[..., 3:]
    vector = w * b[..., :3] + b[..., 3:] * v + np.cross(v, b[..., :3])
    return np.concatenate([vector, w * b[..., 3:] - (v * b[..., :3]).sum(-1, keepdims=True)], -1)


def rotated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) turned by unit quaternions xyzw (..., 4), as Unity's `q * v`."""
    axis = q[..., :3]
    return v + 2 * np.cross(axis, np.cross(axis, v) + q[..., 3:] * v)
