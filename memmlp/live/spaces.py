"""Frames of reference by name, with the conversion from each to AMASS' world and back.

| name   | axes of the world                        | body in its T-pose (its rotations are the identity) |
|--------|------------------------------------------|-----------------------------------------------------|
| amass  | right-handed, Z up                       | SMPL's frame: Y up, faces +Z, left is +X            |
| openxr | right-handed, Y up, -Z forward, +X right | upright in the world, faces -Z, left is -X          |
| unity  | left-handed, Y up, +Z forward, +X right  | upright in the world, faces +Z, left is -X          |

All are in metres. A position (x, y, z) of openxr is (x, -z, y) of amass and (x, y, -z) of unity, so that
forward is +Y of amass. A global rotation turns the T-pose of the third column into the world. In openxr and
unity it is the identity for a person who stands upright and looks forward, so that a headset's own pose is
almost the head's. A local rotation (of a joint relative to its parent) has the T-pose's axes on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from memmlp.common.errors import InputError

SpaceName = Literal["amass", "openxr", "unity"]


@dataclass(frozen=True, eq=False)
class Space:
    """A frame of reference. Arrays may have any leading shape.

    Attributes:
        name: its name for users.
        world: orthogonal (3, 3), from its positions to AMASS' world; it includes a mirroring if the space is
            left-handed.
        body: signs (3,), from the axes of its T-pose to SMPL's body frame; they include a mirroring if
            `world` does.
    """

    name: str
    world: np.ndarray
    body: np.ndarray

    def positions_in(self, positions: np.ndarray) -> np.ndarray:
        """Convert positions (..., 3) from this space to AMASS' world."""
        return positions @ self.world.T

    def positions_out(self, positions: np.ndarray) -> np.ndarray:
        """Convert positions (..., 3) from AMASS' world to this space."""
        return positions @ self.world.astype(positions.dtype)

    def rotations_in(self, rotations: np.ndarray) -> np.ndarray:
        """Convert global rotations (..., 3, 3) from this space to AMASS' world."""
        return self.world @ rotations * self.body

    def rotations_out(self, rotations: np.ndarray) -> np.ndarray:
        """Convert global rotations (..., 3, 3) from AMASS' world to this space."""
        return self.world.T.astype(rotations.dtype) @ rotations * self.body.astype(rotations.dtype)

    def pose_in(self, local: np.ndarray) -> np.ndarray:
        """Convert local rotations (..., J, 3, 3), the root's global, from this space to AMASS' convention."""
        return self._posed(local, self.rotations_in(local[..., 0, :, :]))

    def pose_out(self, local: np.ndarray) -> np.ndarray:
        """Convert local rotations (..., J, 3, 3), the root's global, from AMASS' convention to this space."""
        return self._posed(local, self.rotations_out(local[..., 0, :, :]))

    def _posed(self, local: np.ndarray, root: np.ndarray) -> np.ndarray:
        """Convert local rotations to the other T-pose's axes, and put `root` in place of the root's rotation.

        The signs are their own inverse, so this serves both directions.
        """
        turned = local * np.outer(self.body, self.body).astype(local.dtype)
        turned[..., 0, :, :] = root
        return turned


SPACES = {
    space.name: space
    for space in (
        Space("amass", np.eye(3), np.ones(3)),
        Space("openxr", np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([-1.0, 1, -1])),
        Space("unity", np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]]), np.array([-1.0, 1, 1])),
    )
}


def space_of(name: str) -> Space:
    """Return the space with that name. Raises InputError for an unknown name."""
    if not isinstance(name, str) or name not in SPACES:
        raise InputError(f"space={name}: must be one of {', '.join(SPACES)}")
    return SPACES[name]
