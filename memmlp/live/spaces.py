"""Frames of reference by name, with conversions to AMASS' world and back.

| name   | axes of the world                        | T-pose, where all rotations are the identity        |
|--------|------------------------------------------|-----------------------------------------------------|
| amass  | right-handed, Z up                       | SMPL's frame: Y up, faces +Z, left is +X            |
| openxr | right-handed, Y up, -Z forward, +X right | upright in the world, faces -Z, left is -X          |
| unity  | left-handed, Y up, +Z forward, +X right  | upright in the world, faces +Z, left is -X          |

All positions are in metres. The position (x, y, z) in openxr is (x, -z, y) in amass and (x, y, -z) in unity.
So the forward direction is +Y in amass. A global rotation turns the T-pose of the third column into the
world. In openxr and unity, it is the identity for a person who stands upright and looks forward. So the pose
of a headset is almost the pose of the head. A local rotation is relative to the parent joint, and uses the
axes of the T-pose.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from memmlp.common.errors import InputError

SpaceName = Literal["amass", "openxr", "unity"]


@dataclass(frozen=True, eq=False)
class Space:
    """A frame of reference. `world` is the orthogonal matrix (3, 3) from this space to AMASS' world, `body`
    the signs (3,) from the T-pose axes of this space to SMPL's body frame; both mirror a left-handed space.
    Leading dimensions of arrays are arbitrary."""

    name: str
    world: np.ndarray
    body: np.ndarray

    def convert_positions_to_amass(self, positions: np.ndarray) -> np.ndarray:
        """Convert positions (..., 3) from this space to AMASS' world."""
        return positions @ self.world.T

    def convert_positions_from_amass(self, positions: np.ndarray) -> np.ndarray:
        """Convert positions (..., 3) from AMASS' world to this space."""
        return positions @ self.world.astype(positions.dtype)

    def convert_rotations_to_amass(self, rotations: np.ndarray) -> np.ndarray:
        """Convert global rotations (..., 3, 3) from this space to AMASS' world."""
        return self.world @ rotations * self.body

    def convert_rotations_from_amass(self, rotations: np.ndarray) -> np.ndarray:
        """Convert global rotations (..., 3, 3) from AMASS' world to this space."""
        return self.world.T.astype(rotations.dtype) @ rotations * self.body.astype(rotations.dtype)

    def convert_pose_to_amass(self, local: np.ndarray) -> np.ndarray:
        """Convert local rotations (..., J, 3, 3) to AMASS' convention; the root rotation is global."""
        return self._convert_pose(local, self.convert_rotations_to_amass(local[..., 0, :, :]))

    def convert_pose_from_amass(self, local: np.ndarray) -> np.ndarray:
        """Convert local rotations (..., J, 3, 3) from AMASS' convention; the root rotation is global."""
        return self._convert_pose(local, self.convert_rotations_from_amass(local[..., 0, :, :]))

    def _convert_pose(self, local: np.ndarray, root: np.ndarray) -> np.ndarray:
        """Convert local rotations to the axes of the other T-pose, and replace the root rotation by `root`.
        The signs are their own inverse, so one method converts in both directions."""
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


def find_space(name: str) -> Space:
    """Return the space with a given name. Raises InputError for an unknown name."""
    if not isinstance(name, str) or name not in SPACES:
        raise InputError(f"space={name}: must be one of {', '.join(SPACES)}")
    return SPACES[name]
