"""Frames of reference by name, and the way from each to AMASS' world and back.

| name   | axes of the world                        | body in its T-pose (its rotations are the identity) |
|--------|------------------------------------------|-----------------------------------------------------|
| amass  | right-handed, Z up                       | SMPL's frame: Y up, faces +Z, left is +X            |
| openxr | right-handed, Y up, -Z forward, +X right | upright in the world, faces -Z, left is -X          |
| unity  | left-handed, Y up, +Z forward, +X right  | upright in the world, faces +Z, left is -X          |

All are in metres. Positions: (x, y, z) of openxr is (x, -z, y) of amass and (x, y, -z) of unity, so that
forward is +Y of amass. A global rotation turns the T-pose of the third column into the world: in openxr and
unity it is the identity for a person who stands upright and looks forward, so that a headset's own pose is
almost the head's. A local rotation (of a joint relative to its parent) has the T-pose's axes on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from memmlp.errors import InputError


@dataclass(frozen=True, eq=False)
class Space:
    """A frame of reference. Arrays may have any leading shape.

    Attributes:
        name: by which users call it.
        world: orthogonal (3, 3), its positions -> AMASS' world; mirrors where the space is left-handed.
        body: orthogonal (3, 3), the axes of its T-pose -> SMPL's body frame; mirrors with `world`.
    """

    name: str
    world: np.ndarray
    body: np.ndarray

    def positions_in(self, positions: np.ndarray) -> np.ndarray:
        """Positions (..., 3) of this space in AMASS' world."""
        return positions @ self.world.T

    def positions_out(self, positions: np.ndarray) -> np.ndarray:
        """Positions (..., 3) of AMASS' world in this space."""
        return positions @ self.world

    def rotations_in(self, rotations: np.ndarray) -> np.ndarray:
        """Global rotations (..., 3, 3) of this space in AMASS' world."""
        return self.world @ rotations @ self.body.T

    def rotations_out(self, rotations: np.ndarray) -> np.ndarray:
        """Global rotations (..., 3, 3) of AMASS' world in this space."""
        return self.world.T @ rotations @ self.body

    def pose_in(self, local: np.ndarray) -> np.ndarray:
        """Local rotations (..., J, 3, 3) of this space, the root's global, as AMASS has them."""
        return np.concatenate([self.rotations_in(local[..., :1, :, :]), self._local(local, self.body)], -3)

    def pose_out(self, local: np.ndarray) -> np.ndarray:
        """Local rotations (..., J, 3, 3) as AMASS has them, the root's global, in this space."""
        return np.concatenate([self.rotations_out(local[..., :1, :, :]), self._local(local, self.body.T)], -3)

    @staticmethod
    def _local(local: np.ndarray, way: np.ndarray) -> np.ndarray:
        return way @ local[..., 1:, :, :] @ way.T


SPACES = {
    space.name: space
    for space in (
        Space("amass", np.eye(3), np.eye(3)),
        Space("openxr", np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.diag([-1.0, 1, -1])),
        Space("unity", np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]]), np.diag([-1.0, 1, 1])),
    )
}


def space_of(name: str) -> Space:
    """The space of a name. Raises InputError for an unknown one."""
    if name not in SPACES:
        raise InputError(f"space={name}: no such frame of reference; allowed: {', '.join(SPACES)}")
    return SPACES[name]
