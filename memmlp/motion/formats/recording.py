"""Motion on a file's own skeleton, as importing reads it from any format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

END = ".end"  # an end site's name is that of its joint with this suffix


@dataclass(frozen=True)
class Recording:
    """Motion on a file's own skeleton, in the file's own unit and axes; formats add `kinematics`.

    Attributes:
        path: the file, for messages.
        nodes: the nodes' names, all different; a node comes after its parent.
        node_parents: index of each node's parent; -1 for the root.
        offsets: each node minus its parent in the zero pose (nodes, 3).
        fps: frames per second, as the file states them; None if it does not.
        values: the frames' numbers (N, C), as the file has them.
    """

    path: Path
    nodes: tuple[str, ...]
    node_parents: tuple[int, ...]
    offsets: np.ndarray
    fps: float | None
    values: np.ndarray

    def __len__(self) -> int:
        return len(self.values)

    def zero_pose(self) -> np.ndarray:
        """Return the nodes' positions (nodes, 3) with all rotations zero and the root at the origin."""
        positions = np.zeros_like(self.offsets)
        for node, parent in enumerate(self.node_parents[1:], start=1):
            positions[node] = positions[parent] + self.offsets[node]
        return positions

    def kinematics(self) -> tuple[np.ndarray, np.ndarray]:
        """Return global rotations (N, nodes, 3, 3) and positions (N, nodes, 3) of all frames."""
        raise NotImplementedError

    def pose(self, turns: Mapping[str, Sequence[float]]) -> tuple[np.ndarray, np.ndarray]:
        """Return global rotations (nodes, 3, 3) and positions (nodes, 3) of one pose.

        Args:
            turns: node -> its rotation values as in a frame of the file; the other nodes' values are zero,
                and the root is at the origin.

        Raises:
            InputError: for a wrong number of values.
        """
        raise NotImplementedError
