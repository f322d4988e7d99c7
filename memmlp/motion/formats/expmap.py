"""Reads text of exponential maps in the CMU layout of the papers on human motion prediction.

A file has no header: each line is a frame of 117 numbers with commas between them: three for the root's
position, and three for each of 38 nodes' rotation vectors, radians, Y up. The first line is a T-pose. The
skeleton is that of the database's "MotionBuilder-friendly" BVH conversion, from which the files were made (Li
et al. 2018, "Convolutional Sequence to Sequence Model for Human Dynamics", whose code has the tree and the
offsets), and so are the names here; the three numbers of an end site are zeros. A vector v describes the
inverse rotation: on column vectors, a node's local rotation is exp(-v), since that code multiplies row
vectors from the left.

No file states its frame rate. The published files are at 120 Hz, although the papers treat them as 25 Hz and
one author as 30: only at 120 Hz do walkers move at 1.2 m/s with steps of 0.56 s, and jumpers fall at 10
m/s^2. Human3.6M's files of 99 numbers have another tree, and are refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.motion.formats.recording import Recording

PUBLISHED_FPS = 120.0
LIMIT = 1e4  # the largest size of any number, in the file's unit or radians
MAX_BYTES = 2**26
MAX_LINE = 8000  # bytes

# Node, parent, offset from it in the file's unit (metres: x 0.0564444, as in the map cmu_motionbuilder).
_TREE: tuple[tuple[str, str, tuple[float, float, float]], ...] = (
    ("Hips", "", (0, 0, 0)),
    ("LHipJoint", "Hips", (0, 0, 0)),
    ("LeftUpLeg", "LHipJoint", (1.65674, -1.80282, 0.62477)),
    ("LeftLeg", "LeftUpLeg", (2.59720, -7.13576, 0)),
    ("LeftFoot", "LeftLeg", (2.49236, -6.84770, 0)),
    ("LeftToeBase", "LeftFoot", (0.19704, -0.54136, 2.14581)),
    ("LeftToeBase.end", "LeftToeBase", (0, 0, 1.11249)),
    ("RHipJoint", "Hips", (0, 0, 0)),
    ("RightUpLeg", "RHipJoint", (-1.61070, -1.80282, 0.62476)),
    ("RightLeg", "RightUpLeg", (-2.59502, -7.12977, 0)),
    ("RightFoot", "RightLeg", (-2.46780, -6.78024, 0)),
    ("RightToeBase", "RightFoot", (-0.23024, -0.63258, 2.13368)),
    ("RightToeBase.end", "RightToeBase", (0, 0, 1.11569)),
    ("LowerBack", "Hips", (0, 0, 0)),
    ("Spine", "LowerBack", (0.01961, 2.05450, -0.14112)),
    ("Spine1", "Spine", (0.01021, 2.06436, -0.05921)),
    ("Neck", "Spine1", (0, 0, 0)),
    ("Neck1", "Neck", (0.00713, 1.56711, 0.14968)),
    ("Head", "Neck1", (0.03429, 1.56041, -0.10006)),
    ("Head.end", "Head", (0.01305, 1.62560, -0.05265)),
    ("LeftShoulder", "Spine1", (0, 0, 0)),
    ("LeftArm", "LeftShoulder", (3.54205, 0.90436, -0.17364)),
    ("LeftForeArm", "LeftArm", (4.86513, 0, 0)),
    ("LeftHand", "LeftForeArm", (3.35554, 0, 0)),
    ("LeftFingerBase", "LeftHand", (0, 0, 0)),
    ("LeftHandIndex1", "LeftFingerBase", (0.66117, 0, 0)),
    ("LeftHandIndex1.end", "LeftHandIndex1", (0.53306, 0, 0)),
    ("LThumb", "LeftHand", (0, 0, 0)),
    ("LThumb.end", "LThumb", (0.54120, 0, 0.54120)),
    ("RightShoulder", "Spine1", (0, 0, 0)),
    ("RightArm", "RightShoulder", (-3.49802, 0.75994, -0.32616)),
    ("RightForeArm", "RightArm", (-5.02649, 0, 0)),
    ("RightHand", "RightForeArm", (-3.36431, 0, 0)),
    ("RightFingerBase", "RightHand", (0, 0, 0)),
    ("RightHandIndex1", "RightFingerBase", (-0.73041, 0, 0)),
    ("RightHandIndex1.end", "RightHandIndex1", (-0.58887, 0, 0)),
    ("RThumb", "RightHand", (0, 0, 0)),
    ("RThumb.end", "RThumb", (-0.59786, 0, 0.59786)),
)
NODES = tuple(node for node, _, _ in _TREE)
PARENTS = tuple(NODES.index(parent) if parent else -1 for _, parent, _ in _TREE)
OFFSETS = np.array([offset for _, _, offset in _TREE], float)
WIDTH = 3 + 3 * len(NODES)


@dataclass(frozen=True)
class Expmap(Recording):
    """A file of exponential maps on the CMU skeleton of 38 nodes; end sites are nodes, too."""

    def kinematics(self) -> tuple[np.ndarray, np.ndarray]:
        """Return global rotations (N, 38, 3, 3) and positions (N, 38, 3) of all frames."""
        return _forward(self.values[:, 3:].reshape(-1, len(NODES), 3), self.values[:, :3])

    def pose(self, turns: Mapping[str, Sequence[float]]) -> tuple[np.ndarray, np.ndarray]:
        """Return global rotations (38, 3, 3) and positions (38, 3) of one pose (`Recording.pose`)."""
        vectors = np.zeros((len(NODES), 3))
        for node, vector in turns.items():
            if node not in NODES or len(vector) != 3:
                raise InputError(
                    f"{self.path}: rest.{node} has {len(vector)} values; "
                    "must be three values for a node of the CMU skeleton"
                )
            vectors[NODES.index(node)] = vector
        rotations, positions = _forward(vectors[None], np.zeros((1, 3)))
        return rotations[0], positions[0]


def read_expmap(path: Path) -> Expmap:
    """Read a file of 117 numbers a line; it gets the frame rate of the published files, `PUBLISHED_FPS`.

    Raises:
        InputError: for anything else than lines of 117 finite numbers, or a file of more than 64 MiB; the
            message names the file and where possible the line.
    """
    values = []
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: too large; expected at most {MAX_BYTES >> 20} MiB")
        with open(path, encoding="latin-1") as file:
            for number, line in enumerate(iter(lambda: file.readline(MAX_LINE), ""), start=1):
                if line.strip():
                    values.append(_row(path, number, line))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected a text file") from error
    if not values:
        raise InputError(f"{path}: no frames; expected lines of {WIDTH} numbers")
    return Expmap(path, NODES, PARENTS, OFFSETS, PUBLISHED_FPS, np.array(values))


def _row(path: Path, number: int, line: str) -> np.ndarray:
    def fail(wrong: str) -> NoReturn:
        raise InputError(f"{path}: line {number}: {wrong}; expected {WIDTH} numbers with commas between them")

    words = line.split(",")
    if len(words) != WIDTH:
        fail(f"{len(words)} values")
    try:
        values = np.array([float("nan") if "_" in word else float(word) for word in words])
    except ValueError:
        fail("a value that is not a number")
    if not (np.abs(values) <= LIMIT).all():
        fail(f"a value that is not a number up to {LIMIT:g} in size")
    return values


def _forward(vectors: np.ndarray, root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations (N, 38, 3, 3) and positions (N, 38, 3) of vectors (N, 38, 3) and a root (N, 3)."""
    local = Rotation.from_rotvec(-vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)
    rotations, positions = local, np.empty(vectors.shape)
    positions[:, 0] = root
    for node, parent in enumerate(PARENTS[1:], start=1):
        positions[:, node] = positions[:, parent] + rotations[:, parent] @ OFFSETS[node]
        rotations[:, node] = rotations[:, parent] @ local[:, node]
    return rotations, positions
