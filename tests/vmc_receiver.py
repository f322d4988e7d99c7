"""A receiver of the VMC protocol (protocol.vmc.info/english) in Unity's axes: left-handed, Y up, +Z forward.
It reads OSC as docs/examples/vmc/receive.py does, which is independent of python-osc."""

import runpy
import socket
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

EXAMPLE = runpy.run_path(str(Path(__file__).parent.parent / "docs/examples/vmc/receive.py"))
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
    values: list


class Marionette:
    """Listens at a UDP port of this machine, and poses a body by the messages."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(60)
        self.port = self.socket.getsockname()[1]
        self.bones: dict[str, np.ndarray] = {}
        self.root = np.array([0.0, 0, 0, 0, 0, 0, 1])
        self.time, self.loaded = 0.0, False

    def receive(self) -> list[Message]:
        """Wait for one datagram, and apply its messages."""
        found = [Message(*each) for each in EXAMPLE["messages"](self.socket.recv(65_536))]
        for address, values in found:
            if address == "/VMC/Ext/OK":
                self.loaded = values[0] == 1
            elif address == "/VMC/Ext/T":
                (self.time,) = values
            elif address == "/VMC/Ext/Root/Pos":
                assert values[0] == "root"
                self.root = np.array(values[1:])
            elif address == "/VMC/Ext/Bone/Pos":
                assert values[0] in TREE
                self.bones[values[0]] = np.array(values[1:])
        return found

    def positions(self) -> dict[str, np.ndarray]:
        return {name: at[0] for name, at in posed(self.root, self.bones).items()}

    def close(self) -> None:
        self.socket.close()


def posed(root: np.ndarray, bones: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The positions (N, 3) in Unity's world, given root and bones (N, 7) relative to parents."""

    def split(values: np.ndarray) -> tuple[np.ndarray, Rotation]:
        values = np.atleast_2d(values)
        return values[:, :3], Rotation.from_quat(values[:, 3:])

    place = {None: split(root)}
    for name, parent in TREE.items():
        (at, turned), (offset, turn) = place[parent], split(bones[name])
        place[name] = at + turned.apply(offset), turned * turn
    return {name: at for name, (at, _) in place.items() if name}
