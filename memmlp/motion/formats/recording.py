"""Motion on a file's own skeleton: the common class for all formats that can be imported."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

END = ".end"  # suffix that makes an end site's name from its joint's name


@dataclass(frozen=True)
class Recording:
    """Motion on a file's own skeleton, in the file's unit and axes. Subclasses compute the kinematics.

    Attributes:
        path: the file, for messages.
        nodes: names of the nodes, all different; each node comes after its parent.
        node_parents: index of each node's parent; -1 for the root.
        offsets: each node's position minus its parent's in the zero pose (nodes, 3).
        fps: frame rate in the file, Hz; None without a frame rate.
        values: the numbers of all frames in the file (N, C).
    """

    path: Path
    nodes: tuple[str, ...]
    node_parents: tuple[int, ...]
    offsets: np.ndarray
    fps: float | None
    values: np.ndarray

    def __len__(self) -> int:
        return len(self.values)

    def compute_zero_pose(self) -> np.ndarray:
        """Compute the nodes' positions (nodes, 3) with zero rotations and the root at the origin."""
        positions = np.zeros_like(self.offsets)
        for node, parent in enumerate(self.node_parents[1:], start=1):
            positions[node] = positions[parent] + self.offsets[node]
        return positions

    def compute_kinematics(self) -> tuple[np.ndarray, np.ndarray]:
        """Compute global rotations (N, nodes, 3, 3) and positions (N, nodes, 3) of all frames."""
        raise NotImplementedError

    def compute_pose(self, turns: Mapping[str, Sequence[float]]) -> tuple[np.ndarray, np.ndarray]:
        """Compute global rotations (nodes, 3, 3) and positions (nodes, 3) of one pose with the root at the
        origin, given node -> its rotation values, like in a frame of the file; other nodes' are zero. Raises
        InputError if a node has a wrong number of values."""
        raise NotImplementedError
