"""From motion to the network's 54 inputs, and from the world to the network's space and back."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.body import (
    FRAME_DIM,
    HEAD,
    MOTION_DIM,
    N_JOINTS,
    POSITION,
    ROTATION,
    SPARSE_ANGULAR_VELOCITY,
    SPARSE_DIM,
    SPARSE_POSITION,
    SPARSE_ROTATION,
    SPARSE_VELOCITY,
    TRACKED,
)
from memmlp.geometry import axis_angle_to_matrix, forward_kinematics, matrix_to_sixd, sixd_to_matrix


def sparse_features(rotations: Tensor, positions: Tensor) -> Tensor:
    """The input X of three trackers (AvatarPoser's features, Sec. 3.1 of the paper).

    Args:
        rotations: global rotations of head, left and right wrist (N, 3, 3, 3).
        positions: their global positions (N, 3, 3), metres.

    Returns:
        (N - 1, 54), feature-major as `memmlp.body.SPARSE_*`. Frame 0 has no velocity and is dropped.
    """
    angular = rotations[:-1].transpose(-1, -2) @ rotations[1:]
    parts = [
        matrix_to_sixd(rotations[1:]),
        matrix_to_sixd(angular),
        positions[1:],
        positions[1:] - positions[:-1],
    ]
    return torch.cat([part.flatten(1) for part in parts], 1)


def motion_frames(poses: Tensor, trans: Tensor, rest: Tensor) -> Tensor:
    """Frames [X | Theta] (N - 1, 252) of a clip.

    Args:
        poses: axis-angle (N, 22, 3), the root's global.
        trans: translation (N, 3), metres; the root joint is at rest[0] + trans.
        rest: rest positions (22, 3), metres.
    """
    local = axis_angle_to_matrix(poses)
    rotations, positions = forward_kinematics(local, trans + rest[0], rest)
    tracked = list(TRACKED)
    sparse = sparse_features(rotations[:, tracked], positions[:, tracked])
    theta = torch.cat([matrix_to_sixd(local).flatten(1), positions.flatten(1)], 1)
    return torch.cat([sparse, theta[1:]], 1)


class World:
    """Positions and directions as they are: the most literal reading of the paper.

    The coordinates slot: `place` says, from the inputs of a frame alone, where its local coordinates lie;
    `sparse_in`, `motion_in` and `motion_out` carry inputs and motion there and back.
    """

    def place(self, sparse: Tensor) -> Tensor:
        """The origin (..., 3), metres, of the local coordinates of inputs (..., 54)."""
        return torch.zeros_like(sparse[..., :3])

    def sparse_in(self, sparse: Tensor, place: Tensor) -> Tensor:
        """World inputs (..., 54) in local coordinates."""
        position = sparse[..., SPARSE_POSITION] - _tile(place, len(TRACKED))
        return torch.cat([sparse[..., : SPARSE_POSITION.start], position, sparse[..., SPARSE_VELOCITY]], -1)

    def motion_in(self, motion: Tensor, place: Tensor) -> Tensor:
        """World motion (..., 198) in local coordinates."""
        return torch.cat([motion[..., ROTATION], motion[..., POSITION] - _tile(place, N_JOINTS)], -1)

    def motion_out(self, motion: Tensor, place: Tensor) -> Tensor:
        """Local motion (..., 198) in the world."""
        return torch.cat([motion[..., ROTATION], motion[..., POSITION] + _tile(place, N_JOINTS)], -1)


class HeadRelative(World):
    """Horizontal positions relative to the head of the same frame; heights stay (reading 20)."""

    def place(self, sparse: Tensor) -> Tensor:
        """The head's position on the floor (..., 3), metres."""
        head = sparse[..., SPARSE_POSITION][..., :3]
        return head * head.new_tensor([1.0, 1.0, 0.0])


class Heading(HeadRelative):
    """Relative to the head on the floor, and turned so that the head of the same frame looks ahead.

    Not in the paper. It takes the heading away, which the motion does not depend on. The head's angular
    velocity is local already and stays. The heading is the twist of the head's rotation about the vertical,
    which is defined but where the head is upside down.
    """

    def place(self, sparse: Tensor) -> Tensor:
        """The head's position on the floor and cosine and sine of its heading (..., 5)."""
        first, second = sparse[..., 0:3], sparse[..., 3:6]  # columns of the head's rotation, body frame
        up = torch.linalg.cross(first, second, dim=-1)  # the rest pose has Y up and faces Z
        # A = R Rx(-90 deg) is the rotation from upright; its twist is atan2(a10 - a01, a00 + a11).
        cosine, sine = first[..., 0] - up[..., 1], first[..., 1] + up[..., 0]
        heading = F.normalize(torch.stack([cosine, sine], -1), dim=-1)
        return torch.cat([super().place(sparse), heading], -1)

    def sparse_in(self, sparse: Tensor, place: Tensor) -> Tensor:
        """World inputs (..., 54) in local coordinates."""
        sparse = super().sparse_in(sparse, place[..., :3])
        turned = [
            _turn(sparse[..., SPARSE_ROTATION], place, -1),
            sparse[..., SPARSE_ANGULAR_VELOCITY],
            _turn(sparse[..., SPARSE_POSITION], place, -1),
            _turn(sparse[..., SPARSE_VELOCITY], place, -1),
        ]
        return torch.cat(turned, -1)

    def motion_in(self, motion: Tensor, place: Tensor) -> Tensor:
        """World motion (..., 198) in local coordinates."""
        return self._turned(super().motion_in(motion, place[..., :3]), place, -1)

    def motion_out(self, motion: Tensor, place: Tensor) -> Tensor:
        """Local motion (..., 198) in the world."""
        return super().motion_out(self._turned(motion, place, 1), place[..., :3])

    def _turned(self, motion: Tensor, place: Tensor, way: int) -> Tensor:
        """The root's rotation and the positions turned; the other rotations are local anyway."""
        root, body = motion[..., :6], motion[..., 6 : ROTATION.stop]
        return torch.cat([_turn(root, place, way), body, _turn(motion[..., POSITION], place, way)], -1)


def _turn(vectors: Tensor, place: Tensor, way: int) -> Tensor:
    """Vectors (..., 3 n) turned about the vertical by the heading of a place (..., 5), or back (way -1)."""
    x, y, z = vectors.unflatten(-1, (-1, 3)).unbind(-1)
    cosine, sine = place[..., 3:4], way * place[..., 4:5]
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y, z], -1).flatten(-2)


class Frame(nn.Module):
    """World <-> network space: the choice of coordinates, and z-scores where statistics are given.

    Args:
        coordinates: World(), HeadRelative() or Heading().
        rest: rest positions (22, 3), metres, for forward kinematics.
        mean, std: statistics (252,) of frames [X | Theta] in the chosen coordinates.
    """

    MIN_STD = 1e-3  # a constant feature stays constant instead of becoming noise

    rest: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, coordinates: World, rest: Tensor, mean: Tensor, std: Tensor):
        super().__init__()
        self.coordinates = coordinates
        self.register_buffer("rest", rest.float())
        self.register_buffer("mean", mean.float())
        self.register_buffer("std", std.float().clamp_min(self.MIN_STD))

    @classmethod
    def raw(cls, coordinates: World, rest: Tensor) -> Frame:
        """The frame without normalisation."""
        return cls(coordinates, rest, torch.zeros(FRAME_DIM), torch.ones(FRAME_DIM))

    @classmethod
    def fit(cls, coordinates: World, rest: Tensor, frames: Tensor, chunk: int = 65536) -> Frame:
        """The frame with the z-scores of training frames (F, 252), read chunk by chunk."""
        plain = cls.raw(coordinates, rest).to(frames.device)
        count = len(frames)
        total = torch.zeros(FRAME_DIM, dtype=torch.float64, device=frames.device)
        for part in frames.split(chunk):
            total += plain.encode(part).double().sum(0)
        mean = total / count
        square = torch.zeros_like(total)
        for part in frames.split(chunk):
            square += (plain.encode(part).double() - mean).square().sum(0)
        return cls(coordinates, rest.cpu(), mean.cpu(), (square / count).sqrt().cpu())

    def place(self, sparse: Tensor) -> Tensor:
        """Where (..., 3 or 5) the local coordinates of inputs (..., 54) lie."""
        return self.coordinates.place(sparse)

    def encode(self, frames: Tensor) -> Tensor:
        """World frames [X | Theta] (..., 252) -> network space (..., 252)."""
        sparse, motion = frames[..., :SPARSE_DIM], frames[..., SPARSE_DIM:]
        place = self.place(sparse)
        return torch.cat([self.encode_sparse(sparse, place), self.encode_motion(motion, place)], -1)

    def encode_sparse(self, sparse: Tensor, place: Tensor) -> Tensor:
        """World inputs (..., 54) -> network space (..., 54)."""
        return (self.coordinates.sparse_in(sparse, place) - self.mean[:SPARSE_DIM]) / self.std[:SPARSE_DIM]

    def encode_motion(self, motion: Tensor, place: Tensor) -> Tensor:
        """World motion (..., 198) -> network space (..., 198)."""
        return (self.coordinates.motion_in(motion, place) - self.mean[SPARSE_DIM:]) / self.std[SPARSE_DIM:]

    def decode_motion(self, motion: Tensor, place: Tensor) -> Tensor:
        """Network space (..., 198) -> world motion (..., 198)."""
        return self.coordinates.motion_out(motion * self.std[SPARSE_DIM:] + self.mean[SPARSE_DIM:], place)

    def pose(self, motion: Tensor, sparse: Tensor) -> Tensor:
        """Joint positions (..., 22, 3), metres, world, from the rotations of world motion (..., 198).

        Forward kinematics, translated so that the head stands where its tracker says (field.md).
        """
        local = sixd_to_matrix(motion[..., ROTATION].unflatten(-1, (N_JOINTS, 6)))
        _, positions = forward_kinematics(local, torch.zeros_like(sparse[..., :3]), self.rest)
        head = sparse[..., SPARSE_POSITION][..., :3]
        return positions + (head - positions[..., HEAD, :]).unsqueeze(-2)

    def posed(self, rotation: Tensor, sparse: Tensor) -> Tensor:
        """World motion (..., 198) of rotations (..., 132) in network space at world inputs (..., 54).

        The positions follow from the rotations (`pose`), without gradient.
        """
        motion = F.pad(rotation, (0, MOTION_DIM - ROTATION.stop))
        world = self.decode_motion(motion, self.place(sparse))
        with torch.no_grad():
            positions = self.pose(world, sparse).flatten(-2)
        return torch.cat([world[..., ROTATION], positions], -1)


def _tile(point: Tensor, times: int) -> Tensor:
    """(..., 3) -> (..., 3 * times)."""
    return torch.cat([point] * times, -1)
