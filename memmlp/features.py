"""From motion to the network's 54 inputs, and from the world to the network's space and back."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from memmlp.body import (
    FRAME_DIM,
    HEAD,
    N_JOINTS,
    POSITION,
    ROTATION,
    SPARSE_DIM,
    SPARSE_POSITION,
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
    """Positions as they are: the most literal reading of the paper."""

    def origin(self, sparse: Tensor) -> Tensor:
        """Zeros (..., 3) for inputs (..., 54)."""
        return torch.zeros_like(sparse[..., :3])


class HeadRelative:
    """Horizontal positions relative to the head of the same frame; heights stay (reading 20)."""

    def origin(self, sparse: Tensor) -> Tensor:
        """The head's position on the floor (..., 3), metres, for inputs (..., 54)."""
        head = sparse[..., SPARSE_POSITION][..., :3]
        return head * head.new_tensor([1.0, 1.0, 0.0])


Coordinates = World | HeadRelative


class Frame(nn.Module):
    """World <-> network space: the choice of coordinates, and z-scores where statistics are given.

    Args:
        coordinates: World() or HeadRelative().
        rest: rest positions (22, 3), metres, for forward kinematics.
        mean, std: statistics (252,) of frames [X | Theta] in the chosen coordinates.
    """

    MIN_STD = 1e-3  # a constant feature stays constant instead of becoming noise

    rest: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, coordinates: Coordinates, rest: Tensor, mean: Tensor, std: Tensor):
        super().__init__()
        self.coordinates = coordinates
        self.register_buffer("rest", rest.float())
        self.register_buffer("mean", mean.float())
        self.register_buffer("std", std.float().clamp_min(self.MIN_STD))

    @classmethod
    def raw(cls, coordinates: Coordinates, rest: Tensor) -> Frame:
        """The frame without normalisation."""
        return cls(coordinates, rest, torch.zeros(FRAME_DIM), torch.ones(FRAME_DIM))

    @classmethod
    def fit(cls, coordinates: Coordinates, rest: Tensor, frames: Tensor, chunk: int = 65536) -> Frame:
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

    def origin(self, sparse: Tensor) -> Tensor:
        """The point (..., 3) of the world that positions of that frame are relative to."""
        return self.coordinates.origin(sparse)

    def encode(self, frames: Tensor) -> Tensor:
        """World frames [X | Theta] (..., 252) -> network space (..., 252)."""
        sparse, motion = frames[..., :SPARSE_DIM], frames[..., SPARSE_DIM:]
        return torch.cat([self.encode_sparse(sparse), self.encode_motion(motion, self.origin(sparse))], -1)

    def encode_sparse(self, sparse: Tensor) -> Tensor:
        """World inputs (..., 54) -> network space (..., 54)."""
        relative = sparse[..., SPARSE_POSITION] - _tile(self.origin(sparse), len(TRACKED))
        moved = torch.cat([sparse[..., : SPARSE_POSITION.start], relative, sparse[..., SPARSE_VELOCITY]], -1)
        return (moved - self.mean[:SPARSE_DIM]) / self.std[:SPARSE_DIM]

    def encode_motion(self, motion: Tensor, origin: Tensor) -> Tensor:
        """World motion (..., 198) -> network space (..., 198)."""
        moved = torch.cat([motion[..., ROTATION], motion[..., POSITION] - _tile(origin, N_JOINTS)], -1)
        return (moved - self.mean[SPARSE_DIM:]) / self.std[SPARSE_DIM:]

    def decode_motion(self, motion: Tensor, origin: Tensor) -> Tensor:
        """Network space (..., 198) -> world motion (..., 198)."""
        moved = motion * self.std[SPARSE_DIM:] + self.mean[SPARSE_DIM:]
        return torch.cat([moved[..., ROTATION], moved[..., POSITION] + _tile(origin, N_JOINTS)], -1)

    def pose(self, motion: Tensor, sparse: Tensor) -> Tensor:
        """Joint positions (..., 22, 3), metres, world, from the rotations of world motion (..., 198).

        Forward kinematics, translated so that the head stands where its tracker says (field.md).
        """
        local = sixd_to_matrix(motion[..., ROTATION].unflatten(-1, (N_JOINTS, 6)))
        _, positions = forward_kinematics(local, torch.zeros_like(sparse[..., :3]), self.rest)
        head = sparse[..., SPARSE_POSITION][..., :3]
        return positions + (head - positions[..., HEAD, :]).unsqueeze(-2)


def _tile(point: Tensor, times: int) -> Tensor:
    """(..., 3) -> (..., 3 * times)."""
    return torch.cat([point] * times, -1)
