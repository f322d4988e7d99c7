"""Motion on a file's own skeleton: the common class and the checks of all formats that can be imported."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn, TextIO

import numpy as np

from memmlp.common.errors import InputError

END = ".end"  # suffix that makes an end site's name from its joint's name
LIMIT = 1e6  # maximum absolute value of all numbers in a file
MAX_BYTES = 2**28  # about half an hour of BVH with 93 channels at 120 Hz


@dataclass(frozen=True)
class Recording:
    """Motion on a file's own skeleton, in the file's unit and axes. Subclasses compute the kinematics."""

    path: Path  # the file, for messages
    nodes: tuple[str, ...]  # names of the nodes, all different; each node comes after its parent
    node_parents: tuple[int, ...]  # index of each node's parent; -1 for the root
    offsets: np.ndarray  # each node's position minus its parent's in the zero pose (nodes, 3)
    fps: float | None  # frame rate in the file, Hz; None without a frame rate
    values: np.ndarray  # the numbers of all frames in the file (N, C)

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
        values: list[float] = []
        for node, rests in enumerate(self.list_rest_values()):
            name, count = self.nodes[node], rests.count(None)
            angles = list(turns.get(name, [0.0] * count))
            if len(angles) != count:
                raise InputError(
                    f"{self.path}: rest.{name} has {len(angles)} values; must have {count}, one per angle"
                )
            values += [angles.pop(0) if rest is None else rest for rest in rests]
        rotations, positions = replace(self, values=np.array([values])).compute_kinematics()
        return rotations[0], positions[0]

    def list_rest_values(self) -> list[list[float | None]]:
        """Return for each node the values of a frame with the zero pose at the origin; None for angles."""
        raise NotImplementedError


@contextmanager
def open_text(path: Path, encoding: str) -> Iterator[TextIO]:
    """Open a text file. Raises InputError if it cannot be read, or is too large."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: too large; must be at most {MAX_BYTES >> 20} MiB")
        with open(path, encoding=encoding) as file:
            yield file
    except OSError as error:
        expected = f"expected a {path.suffix} file"
        raise InputError(f"{path}: cannot be read ({error.strerror}); {expected}") from error


def fail(path: Path, line: int, wrong: str, expected: str) -> NoReturn:
    raise InputError(f"{path}: line {line}: {wrong}; expected {expected}")
