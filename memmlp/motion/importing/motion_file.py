"""The interface to a motion file of any format, as importing needs it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np


class MotionFile(Protocol):
    """Motion on a file's own skeleton, in the file's own unit and axes (`formats.bvh.Bvh` is one)."""

    @property
    def path(self) -> Path:
        """The file's path, for messages."""
        ...

    @property
    def nodes(self) -> tuple[str, ...]:
        """The nodes' names, all different; a node comes after its parent."""
        ...

    @property
    def node_parents(self) -> tuple[int, ...]:
        """The index of each node's parent; -1 for the root."""
        ...

    @property
    def fps(self) -> float:
        """Frames per second, as the file states them."""
        ...

    def zero_pose(self) -> np.ndarray:
        """Return the nodes' positions (nodes, 3) where all rotations are the identity."""
        ...

    def kinematics(self) -> tuple[np.ndarray, np.ndarray]:
        """Return global rotations (N, nodes, 3, 3) and positions (N, nodes, 3) of all frames."""
        ...

    def posed(self, angles: Mapping[str, Sequence[float]]) -> tuple[np.ndarray, np.ndarray]:
        """Return global rotations (nodes, 3, 3) and positions (nodes, 3) of a pose.

        The pose is given by nodes' rotation values as in a frame of the file; the other nodes' values are
        zero.
        """
        ...

    def __len__(self) -> int: ...
