"""The coordinates slot: the local coordinates in which a network sees the world."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from memmlp.common.components import component
from memmlp.motion.body import (
    N_JOINTS,
    POSITION,
    ROTATION,
    SPARSE_ANGULAR_VELOCITY,
    SPARSE_POSITION,
    SPARSE_ROTATION,
    SPARSE_VELOCITY,
    TRACKED,
)


class Coordinates:
    """The slot's interface; methods that are not overridden use the world's own coordinates.

    `origin` computes the origin of a frame's local coordinates from its inputs; `sparse_in`, `motion_in`
    and `motion_out` convert inputs and motion to and from them.
    """

    def origin(self, sparse: Tensor) -> Tensor:
        """Return the origin (..., 3), metres, of the local coordinates of inputs (..., 54): here zeros."""
        return torch.zeros_like(sparse[..., :3])

    def sparse_in(self, sparse: Tensor, origin: Tensor) -> Tensor:
        """Convert world inputs (..., 54) to local coordinates."""
        position = sparse[..., SPARSE_POSITION] - _tile(origin, len(TRACKED))
        return torch.cat([sparse[..., : SPARSE_POSITION.start], position, sparse[..., SPARSE_VELOCITY]], -1)

    def motion_in(self, motion: Tensor, origin: Tensor) -> Tensor:
        """Convert world motion (..., 198) to local coordinates."""
        return torch.cat([motion[..., ROTATION], motion[..., POSITION] - _tile(origin, N_JOINTS)], -1)

    def motion_out(self, motion: Tensor, origin: Tensor) -> Tensor:
        """Convert local motion (..., 198) to the world."""
        return torch.cat([motion[..., ROTATION], motion[..., POSITION] + _tile(origin, N_JOINTS)], -1)

    def rotations_out(self, rotations: Tensor, origin: Tensor) -> Tensor:
        """Convert joints' global rotations (..., 6 n), 6D, from local coordinates to the world."""
        return rotations


@component("coordinates", "world")
class World(Coordinates):
    """The world's own coordinates: the most literal reading of the paper."""


@component("coordinates", "head_relative")
class HeadRelative(Coordinates):
    """Coordinates with the head of the same frame as horizontal origin and unchanged heights (reading 20)."""

    def origin(self, sparse: Tensor) -> Tensor:
        """Return the head's position on the floor (..., 3), metres, for inputs (..., 54)."""
        head = sparse[..., SPARSE_POSITION][..., :3]
        return head * head.new_tensor([1.0, 1.0, 0.0])


@component("coordinates", "heading")
class Heading(HeadRelative):
    """Coordinates relative to the head on the floor, turned so that the head of the same frame faces ahead.

    They are not in the paper. They remove the heading, because the motion does not depend on it. The head's
    angular velocity is local already and stays. The heading is the twist of the head's rotation about the
    vertical, which is defined unless the head is upside down.
    """

    def origin(self, sparse: Tensor) -> Tensor:
        """Return the head's position on the floor, metres, and its heading's cosine and sine (..., 5)."""
        # The rest pose has Y up and faces Z. Of the head's rotation R, whose first columns are a and b,
        # A = R Rx(-90 deg) is the rotation from upright. Its twist is atan2(A10 - A01, A00 + A11): both are
        # the level part of a, plus that of a x b turned by a right angle.
        a, a_up, b, b_up = sparse[..., :6].split([2, 1, 2, 1], -1)
        heading = F.normalize(a + (a * b_up - a_up * b), dim=-1)
        return torch.cat([super().origin(sparse), heading], -1)

    def sparse_in(self, sparse: Tensor, origin: Tensor) -> Tensor:
        """Convert world inputs (..., 54) to local coordinates."""
        sparse = super().sparse_in(sparse, origin[..., :3])
        turned = [
            _turn(sparse[..., SPARSE_ROTATION], origin, -1),
            sparse[..., SPARSE_ANGULAR_VELOCITY],
            _turn(sparse[..., SPARSE_POSITION], origin, -1),
            _turn(sparse[..., SPARSE_VELOCITY], origin, -1),
        ]
        return torch.cat(turned, -1)

    def motion_in(self, motion: Tensor, origin: Tensor) -> Tensor:
        """Convert world motion (..., 198) to local coordinates."""
        return self._turned(super().motion_in(motion, origin[..., :3]), origin, -1)

    def motion_out(self, motion: Tensor, origin: Tensor) -> Tensor:
        """Convert local motion (..., 198) to the world."""
        return super().motion_out(self._turned(motion, origin, 1), origin[..., :3])

    def rotations_out(self, rotations: Tensor, origin: Tensor) -> Tensor:
        """Convert joints' global rotations (..., 6 n), 6D, from local coordinates to the world."""
        return _turn(rotations, origin, 1)

    def _turned(self, motion: Tensor, origin: Tensor, way: int) -> Tensor:
        """Turn the root's rotation and the positions; the other rotations are local, so they stay."""
        root, body = motion[..., :6], motion[..., 6 : ROTATION.stop]
        return torch.cat([_turn(root, origin, way), body, _turn(motion[..., POSITION], origin, way)], -1)


def _turn(vectors: Tensor, origin: Tensor, way: int) -> Tensor:
    """Turn vectors (..., 3 n) about the vertical by the heading of an origin (..., 5), or back (way -1)."""
    x, y, z = vectors.unflatten(-1, (-1, 3)).unbind(-1)
    cosine, sine = origin[..., 3:4], way * origin[..., 4:5]
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y, z], -1).flatten(-2)


def _tile(point: Tensor, times: int) -> Tensor:
    """Repeat a point: (..., 3) to (..., 3 * times)."""
    return torch.cat([point] * times, -1)
