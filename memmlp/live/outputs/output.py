"""The slot of an output, and the frames that it gets: the wearer's body."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from memmlp.live.rotations import quaternion_to_matrix
from memmlp.live.stream import Pose, Stream


class BodyFrame(NamedTuple):
    """The wearer's body at a time, in AMASS' conventions, with the floor at height zero.

    Attributes:
        time: seconds of the trackers' clock.
        local: rotations (22, 3, 3), relative to the parents, except for the root's, which is global.
        positions: the joints (22, 3), metres.
        rest: the joints in the rest pose (22, 3), metres, SMPL's body frame, at the wearer's height.
        scale: the network's body height divided by the wearer's.
        restarted: whether the network began anew at this frame.
    """

    time: float
    local: np.ndarray
    positions: np.ndarray
    rest: np.ndarray
    scale: float
    restarted: bool


class Output(Protocol):
    """Takes frames without ever waiting: each frame is taken at once, or dropped.

    Attributes:
        name: the output in words.
    """

    name: str

    def take(self, frame: BodyFrame) -> None:
        """Take a frame. Raises OSError if that fails."""

    def close(self) -> None:
        """Finish what was begun, such as files."""


def body_frame(stream: Stream, pose: Pose) -> BodyFrame:
    """Return a pose of a stream as a frame in AMASS' conventions."""
    local = pose.rotations if pose.rotations.ndim == 3 else quaternion_to_matrix(pose.rotations)
    space, wearer = stream.space, stream.wearer
    positions = space.positions_in(pose.positions) - [0.0, 0.0, wearer.floor]
    return BodyFrame(pose.time, space.pose_in(local), positions, stream.rest, wearer.scale, pose.restarted)


class Outputs:
    """Several outputs; one that fails is reported once, and tried again with the next frame.

    Args:
        outputs: the outputs.
        tell: gets a line about each output that fails.
    """

    def __init__(self, outputs: Sequence[Output], tell: Callable[[str], None]):
        self.outputs, self.tell = outputs, tell
        self.failed: set[str] = set()

    def take(self, stream: Stream, pose: Pose) -> None:
        """Give a pose of a stream to all outputs."""
        if not self.outputs:
            return
        frame = body_frame(stream, pose)
        for output in self.outputs:
            try:
                output.take(frame)
            except OSError as error:
                self._report(output.name, error)

    def _report(self, name: str, error: OSError) -> None:
        if name not in self.failed:
            self.failed.add(name)
            self.tell(f"{name}: {error.strerror or error}; the others go on")

    def close(self) -> None:
        """Close all outputs, even if closing one of them fails; the first error is raised at the end."""
        errors = []
        for output in self.outputs:
            try:
                output.close()
            except Exception as error:
                errors.append(error)
        if errors:
            raise errors[0]
