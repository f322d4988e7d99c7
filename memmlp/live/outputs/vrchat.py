"""VRChat's OSC trackers: up to eight, at the places where VRChat expects full-body trackers, and the head.

By VRChat's documentation (docs.vrchat.com/docs/osc-trackers): `/tracking/trackers/1/position` and so on,
three floats each; metres of the real world and Euler angles in degrees, applied in the order Z, X, Y, in
Unity's frame of reference. VRChat finds out which tracker is which when the wearer calibrates in its T-pose.
It shifts all trackers so that the head is at its avatar's head bone, and turns them to the head's heading.
"""

from __future__ import annotations

import numpy as np

from memmlp.live.outputs.osc import Bundle, Message, Receiver
from memmlp.live.outputs.output import BodyFrame
from memmlp.live.spaces import SPACES
from memmlp.motion.body import JOINTS, N_JOINTS, PARENTS

PORT = 9000
SPACE = SPACES["unity"]
# The joint where a tracker is, and the joint whose bone it turns with: a knee's with the thigh, an elbow's
# with the upper arm.
PLACES = (
    ("pelvis", "pelvis"), ("spine3", "spine3"), ("left_ankle", "left_ankle"), ("right_ankle", "right_ankle"),
    ("left_knee", "left_hip"), ("right_knee", "right_hip"),
    ("left_elbow", "left_shoulder"), ("right_elbow", "right_shoulder"), ("head", "head"),
)  # fmt: skip
AT, TURNS_WITH = ([JOINTS.index(pair[k]) for pair in PLACES] for k in (0, 1))
NAMES = (*map(str, range(1, len(PLACES))), "head")


class VRChat:
    """An output that sends trackers to VRChat.

    Args:
        receiver: VRChat's address.
    """

    def __init__(self, receiver: Receiver):
        self.name = f"VRChat at {receiver}"
        self.receiver = receiver
        parts = [f"/tracking/trackers/{name}/{part}" for name in NAMES for part in ("position", "rotation")]
        self.bundle = Bundle([Message(address, (), 3) for address in parts])

    def take(self, frame: BodyFrame) -> None:
        """Send the frame's trackers, in one datagram."""
        self.receiver.send(self.bundle.write(trackers(frame).ravel()))

    def close(self) -> None:
        """Release the socket."""
        self.receiver.close()


def trackers(frame: BodyFrame) -> np.ndarray:
    """Return position (metres) and Euler angles (degrees) of trackers and head (9, 2, 3), in Unity's axes."""
    positions = SPACE.positions_out(frame.positions[AT])
    angles = euler_degrees(SPACE.rotations_out(global_rotations(frame.local)[TURNS_WITH]))
    return np.stack([positions, angles], 1)


def global_rotations(local: np.ndarray) -> np.ndarray:
    """Return global rotations (22, 3, 3) from local ones, of which the root's is global already."""
    turned = np.array(local, np.float64)
    for joint in range(1, N_JOINTS):
        turned[joint] = turned[PARENTS[joint]] @ turned[joint]
    return turned


def euler_degrees(rotations: np.ndarray) -> np.ndarray:
    """Return Unity's angles (n, 3) about X, Y and Z, degrees, with Ry Rx Rz = rotations (n, 3, 3).

    The product is correct in gimbal lock, too, where the angle about X is a right angle.
    """
    y = np.arctan2(rotations[:, 0, 2], rotations[:, 2, 2])
    cosine, sine = np.cos(y)[:, None], np.sin(y)[:, None]
    first = cosine * rotations[:, 0] - sine * rotations[:, 2]  # rows of Ry^T R = Rx Rz
    third = sine * rotations[:, 0] + cosine * rotations[:, 2]
    x = np.arctan2(-rotations[:, 1, 2], third[:, 2])
    z = np.arctan2(-first[:, 1], first[:, 0])
    return np.degrees(np.stack([x, y, z], 1))
