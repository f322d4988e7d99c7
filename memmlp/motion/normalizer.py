"""The conversion between world frames and network space: local coordinates and z-scores."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.motion.body import (
    FRAME_DIM,
    HEAD,
    MOTION_DIM,
    N_JOINTS,
    PARENTS,
    ROTATION,
    SPARSE_DIM,
    SPARSE_POSITION,
)
from memmlp.motion.geometry import build_bone_chains, forward_kinematics, matrix_to_sixd, sixd_to_matrix
from memmlp.motion.network_coordinates import Coordinates

Change = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""A function that changes a pose in the world. Its arguments are global rotations (..., 22, 3, 3), joints
(..., 22, 3), inputs (..., 54) and rest joints (22, 3). It returns rotations and joints."""


def use_float32(device: torch.device) -> AbstractContextManager[object]:
    """Compute in float32 within the context, even with mixed precision (`optim.precision=bf16`). It has no
    effect without mixed precision, or on exported graphs."""
    mixed = torch.is_autocast_enabled(device.type)
    return torch.autocast(device.type, enabled=False) if mixed else nullcontext()


class Normalizer(nn.Module):
    """Converts between world frames and network space: local `coordinates` and z-scores by mean and standard
    deviation (252,) of frames [X | Theta] in them; deviations below 1e-3 count as 1e-3. Forward kinematics
    uses the rest positions (22, 3), metres."""

    MIN_STD = 1e-3  # a smaller divisor would turn constant features into noise

    rest: Tensor
    mean: Tensor
    std: Tensor
    chains: Tensor

    def __init__(self, coordinates: Coordinates, rest: Tensor, mean: Tensor, std: Tensor):
        super().__init__()
        self.coordinates = coordinates
        self.register_buffer("rest", rest.float())
        self.register_buffer("mean", mean.float())
        self.register_buffer("std", std.float().clamp_min(self.MIN_STD))
        self.register_buffer("chains", build_bone_chains(), persistent=False)

    @classmethod
    def from_coordinates(cls, coordinates: Coordinates, rest: Tensor) -> Normalizer:
        """Make a normalizer without z-scores, which changes only the coordinates."""
        return cls(coordinates, rest, torch.zeros(FRAME_DIM), torch.ones(FRAME_DIM))

    @classmethod
    def fit(cls, coordinates: Coordinates, rest: Tensor, frames: Tensor, chunk: int = 65536) -> Normalizer:
        """Make a normalizer with z-scores from training frames (F, 252), which are read in chunks."""
        plain = cls.from_coordinates(coordinates, rest).to(frames.device)
        count = len(frames)
        total = torch.zeros(FRAME_DIM, dtype=torch.float64, device=frames.device)
        for part in frames.split(chunk):
            total += plain.encode(part).double().sum(0)
        mean = total / count
        square = torch.zeros_like(total)
        for part in frames.split(chunk):
            square += (plain.encode(part).double() - mean).square().sum(0)
        return cls(coordinates, rest.cpu(), mean.cpu(), (square / count).sqrt().cpu())

    def find_origin(self, sparse: Tensor) -> Tensor:
        """Return the origin (..., 3 or 5) of the local coordinates for inputs (..., 54)."""
        return self.coordinates.find_origin(sparse)

    def encode(self, frames: Tensor) -> Tensor:
        """Convert world frames [X | Theta] (..., 252) to network space (..., 252)."""
        sparse, motion = frames[..., :SPARSE_DIM], frames[..., SPARSE_DIM:]
        origin = self.find_origin(sparse)
        return torch.cat([self.encode_sparse(sparse, origin), self.encode_motion(motion, origin)], -1)

    def encode_sparse(self, sparse: Tensor, origin: Tensor) -> Tensor:
        """Convert world inputs (..., 54) with the given origin to network space (..., 54)."""
        local = self.coordinates.convert_inputs_to_local(sparse, origin)
        return (local - self.mean[:SPARSE_DIM]).div_(self.std[:SPARSE_DIM])

    def encode_motion(self, motion: Tensor, origin: Tensor) -> Tensor:
        """Convert world motion (..., 198) with the given origin to network space (..., 198)."""
        local = self.coordinates.convert_motion_to_local(motion, origin)
        return (local - self.mean[SPARSE_DIM:]).div_(self.std[SPARSE_DIM:])

    def decode_motion(self, motion: Tensor, origin: Tensor) -> Tensor:
        """Convert motion (..., 198) in network space with the given origin to the world (..., 198)."""
        local = (motion * self.std[SPARSE_DIM:]).add_(self.mean[SPARSE_DIM:])
        return self.coordinates.convert_motion_to_world(local, origin)

    def convert_rotations_to_world(self, rotations: Tensor, origin: Tensor) -> Tensor:
        """Convert joints' global rotations (..., 6 n), 6D, from local coordinates to the world."""
        return self.coordinates.convert_rotations_to_world(rotations, origin)

    def compute_positions(self, motion: Tensor, sparse: Tensor) -> Tensor:
        """Compute joint positions (..., 22, 3), metres, world, from the rotations in world motion (..., 198).
        The translation puts the head at the tracker's position in the world inputs (..., 54)
        (docs/readings.md, no. 22)."""
        rotations = motion[..., ROTATION].to(sparse.dtype).unflatten(-1, (N_JOINTS, 6))
        with use_float32(sparse.device):
            root = torch.zeros_like(sparse[..., :3])
            _, positions = forward_kinematics(sixd_to_matrix(rotations), root, self.rest)
        head = sparse[..., SPARSE_POSITION][..., :3]
        return positions + (head - positions[..., HEAD, :]).unsqueeze(-2)

    def decode_rotations(self, rotation: Tensor, sparse: Tensor) -> Tensor:
        """Convert network-space rotations (..., 132) to world motion (..., 198), for world inputs (..., 54).
        `compute_positions` adds the positions, without gradients."""
        motion = F.pad(rotation, (0, MOTION_DIM - ROTATION.stop))
        world = self.decode_motion(motion, self.find_origin(sparse))
        positions = self.compute_positions(world.detach(), sparse).flatten(-2)
        return torch.cat([world[..., ROTATION], positions], -1)

    def build_world_motion(self, rotations: Tensor, sparse: Tensor, change: Change | None = None) -> Tensor:
        """Build world motion (..., 198) from global rotations (..., 132), 6D, and world inputs (..., 54). The
        positions are sums of the rotated bones, with the head at its tracker and without gradients. `change`
        may change the pose before the rotations are converted to local ones."""
        matrices = sixd_to_matrix(rotations.unflatten(-1, (N_JOINTS, 6)))
        parents = matrices[..., list(PARENTS[1:]), :, :]
        offsets = self.rest[1:] - self.rest[list(PARENTS[1:])]
        bones = (parents.detach() @ offsets[..., None])[..., 0]
        positions = self.chains @ bones + sparse[..., SPARSE_POSITION][..., None, :3]
        if change:
            matrices, positions = change(matrices, positions, sparse, self.rest)
            parents = matrices[..., list(PARENTS[1:]), :, :]
        local = parents.transpose(-1, -2) @ matrices[..., 1:, :, :]
        return torch.cat([rotations[..., :6], matrix_to_sixd(local).flatten(-2), positions.flatten(-2)], -1)
