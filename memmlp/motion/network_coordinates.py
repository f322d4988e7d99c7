"""The component slot `coordinates`: the local coordinates of a network's inputs and outputs."""

import torch
import torch.nn.functional as F
from torch import Tensor

from memmlp.common.components import component
from memmlp.motion.body import (
    MOTION_DIM,
    POSITION,
    ROTATION,
    SPARSE_ANGULAR_VELOCITY,
    SPARSE_DIM,
    SPARSE_POSITION,
    SPARSE_ROTATION,
    SPARSE_VELOCITY,
)


class Coordinates:
    """The slot's interface. Methods that are not overridden use world coordinates. Each frame has its own
    local coordinates: `find_origin` computes their origin from the frame's inputs; the other methods convert.
    """

    def find_origin(self, sparse: Tensor) -> Tensor:
        """Return the origin (..., 3), metres, of local coordinates for inputs (..., 54). Default: zeros."""
        return torch.zeros_like(sparse[..., :3])

    def find_turn(self, sparse: Tensor) -> Tensor:
        """Return the numbers that follow the position in the origin (..., 0 or 2)."""
        return self.find_origin(sparse)[..., 3:]

    def convert_inputs_to_local(self, sparse: Tensor, origin: Tensor) -> Tensor:
        """Convert world inputs (..., 54) to local coordinates."""
        return sparse - _place_points(origin, SPARSE_POSITION, SPARSE_DIM)

    def convert_motion_to_local(self, motion: Tensor, origin: Tensor) -> Tensor:
        """Convert world motion (..., 198) to local coordinates."""
        return motion - _place_points(origin, POSITION, MOTION_DIM)

    def convert_motion_to_world(self, motion: Tensor, origin: Tensor) -> Tensor:
        """Convert local motion (..., 198) to the world."""
        return motion + _place_points(origin, POSITION, MOTION_DIM)

    def convert_rotations_to_world(self, rotations: Tensor, origin: Tensor) -> Tensor:
        """Convert joints' global rotations (..., 6 n), 6D, from local coordinates to the world."""
        return rotations


@component("coordinates", "world")
class World(Coordinates):
    """World coordinates: the most literal interpretation of the paper."""


@component("coordinates", "head_relative")
class HeadRelative(Coordinates):
    """Coordinates relative to the head's position on the floor in the same frame (docs/readings.md, no. 20).
    Heights stay unchanged."""

    def find_origin(self, sparse: Tensor) -> Tensor:
        """Return the head's position on the floor (..., 3), metres, for inputs (..., 54)."""
        head = sparse[..., SPARSE_POSITION][..., :3]
        return head * head.new_tensor([1.0, 1.0, 0.0])


@component("coordinates", "heading")
class Heading(HeadRelative):
    """Coordinates relative to the head's position on the floor and its heading in the same frame.

    They are not in the paper. They remove the heading, because the motion does not depend on it. The angular
    velocities are local already and stay unchanged. The heading is the twist of the head's rotation about the
    vertical. It is undefined only if the head is upside down.
    """

    def find_origin(self, sparse: Tensor) -> Tensor:
        """Return (..., 5): the head's position on the floor, metres, and its heading's cosine and sine."""
        return torch.cat([super().find_origin(sparse), self.find_turn(sparse)], -1)

    def find_turn(self, sparse: Tensor) -> Tensor:
        """Return the heading's cosine and sine (..., 2)."""
        # The rest pose has Y up and faces Z. Of the head's rotation R, whose first columns are a and b,
        # A = R Rx(-90 deg) is the rotation from upright. Its twist is atan2(A10 - A01, A00 + A11). Both
        # arguments are the horizontal part of a plus the horizontal part of a x b, rotated by 90 degrees.
        a, a_up, b, b_up = sparse[..., :6].split([2, 1, 2, 1], -1)
        heading = a + (a * b_up - a_up * b)
        return heading / heading.norm(dim=-1, keepdim=True).clamp_min(1e-12)

    def convert_inputs_to_local(self, sparse: Tensor, origin: Tensor) -> Tensor:
        rotated = [
            _turn_vectors(sparse[..., SPARSE_ROTATION], origin, -1),
            sparse[..., SPARSE_ANGULAR_VELOCITY],
            _turn_vectors(sparse[..., SPARSE_POSITION], origin, -1, are_points=True),
            _turn_vectors(sparse[..., SPARSE_VELOCITY], origin, -1),
        ]
        return torch.cat(rotated, -1)

    def convert_motion_to_local(self, motion: Tensor, origin: Tensor) -> Tensor:
        return self._turn_motion(motion, origin, -1)

    def convert_motion_to_world(self, motion: Tensor, origin: Tensor) -> Tensor:
        return self._turn_motion(motion, origin, 1)

    def convert_rotations_to_world(self, rotations: Tensor, origin: Tensor) -> Tensor:
        return _turn_vectors(rotations, origin, 1)

    def _turn_motion(self, motion: Tensor, origin: Tensor, way: int) -> Tensor:
        """Turn the root's rotation and the positions. Other rotations are local and stay unchanged."""
        root, body, positions = motion.split([6, ROTATION.stop - 6, MOTION_DIM - ROTATION.stop], -1)
        positions = _turn_vectors(positions, origin, way, are_points=True)
        return torch.cat([_turn_vectors(root, origin, way), body, positions], -1)


def _turn_vectors(vectors: Tensor, origin: Tensor, way: int, are_points: bool = False) -> Tensor:
    """Turn vectors (..., 3 n) about the vertical by an origin's heading (..., 5), or back for `way` -1.
    Points also move by its position."""
    x, y, z = vectors.unflatten(-1, (-1, 3)).unbind(-1)
    *place, cosine, sine = origin.split(1, -1)
    sine = way * sine
    if are_points and way < 0:
        x, y, z = (one - by for one, by in zip((x, y, z), place, strict=True))
    x, y = cosine * x - sine * y, sine * x + cosine * y
    if are_points and way > 0:
        x, y, z = (one + by for one, by in zip((x, y, z), place, strict=True))
    return torch.stack([x, y, z], -1).flatten(-2)


def _place_points(point: Tensor, place: slice, size: int) -> Tensor:
    """Repeat a point (..., 3) over a slice of features, with zeros elsewhere: (..., size)."""
    repeated = point.repeat(*[1] * (point.dim() - 1), (place.stop - place.start) // 3)
    return F.pad(repeated, (place.start, size - place.stop))
