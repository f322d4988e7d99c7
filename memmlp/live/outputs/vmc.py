"""The VMC protocol: a performer's bones over OSC, as VSeeFace, Warudo, EVMC4U and others take them.

By the specification (protocol.vmc.info/english), each frame: `/VMC/Ext/OK` (version 2.5: loaded, calibrated,
normal mode), `/VMC/Ext/T` (seconds since the beginning), `/VMC/Ext/Root/Pos` and for each bone
`/VMC/Ext/Bone/Pos` (name, position and quaternion xyzw in the parent's frame). The frame of reference is
Unity's. In the rest pose, a T-pose that faces +Z, all rotations are the identity.

The root stays at the origin, and all movement is in the hips, since not all programs apply the root's.
"""

from __future__ import annotations

import numpy as np

from memmlp.live.outputs.osc import Bundle, Message, Receiver
from memmlp.live.outputs.output import BodyFrame
from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.spaces import SPACES
from memmlp.motion.body import N_JOINTS, PARENTS, ROOT
from memmlp.motion.formats.vrm import UNITY_BONES as UNITY

PORT = 39539
SPACE = SPACES["unity"]
HALF = N_JOINTS // 2  # bones of a bundle, so that it is one Ethernet packet
LOADED, CALIBRATED, NORMAL = 1, 3, 0
STILL = np.array([0.0, 0, 0, 0, 0, 0, 1])  # position and quaternion of a root that stays


class VMC:
    """An output that sends bones by the VMC protocol.

    Args:
        receiver: the program that takes them.
    """

    def __init__(self, receiver: Receiver):
        self.name = f"VMC to {receiver}"
        self.receiver, self.began = receiver, 0.0
        self.started = False
        bones = [Message("/VMC/Ext/Bone/Pos", (name,), 7) for name in UNITY]
        status = [
            Message("/VMC/Ext/OK", (LOADED, CALIBRATED, NORMAL)),
            Message("/VMC/Ext/T", (), 1),
            Message("/VMC/Ext/Root/Pos", ("root",), 7),
        ]
        self.bundles = Bundle([*status, *bones[:HALF]]), Bundle(bones[HALF:])

    def take(self, frame: BodyFrame) -> None:
        """Send the frame's bones, in two datagrams."""
        if not self.started:
            self.started, self.began = True, frame.time
        values = bones(frame)
        first, second = self.bundles
        status = np.concatenate([[frame.time - self.began], STILL])
        self.receiver.send(first.write(np.concatenate([status, values[:HALF].ravel()])))
        self.receiver.send(second.write(values[HALF:].ravel()))

    def close(self) -> None:
        """Release the socket."""
        self.receiver.close()


def bones(frame: BodyFrame) -> np.ndarray:
    """Return each bone's position, metres, and quaternion xyzw in its parent's frame (22, 7), for Unity."""
    values = np.empty((N_JOINTS, 7))
    offsets = frame.rest - frame.rest[list(PARENTS)]  # the root's is replaced
    values[:, :3] = offsets * SPACE.body
    values[ROOT, :3] = SPACE.positions_out(frame.positions[ROOT])
    values[:, 3:] = matrix_to_quaternion(SPACE.pose_out(frame.local))
    return values
