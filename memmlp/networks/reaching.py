"""Arms that reach to the hands' trackers, in closed form.

Two bones whose ends are known leave the elbow a circle (Tolani et al. 2000). Where on it the elbow is, a
network predicts. What else it predicted of an arm gives way, as the tracker knows better.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from memmlp.motion.body import HEAD, SPARSE_POSITION, SPARSE_ROTATION
from memmlp.motion.geometry import sixd_to_matrix
from memmlp.networks.baselines.limb_solver import (
    BASES,
    ENDS,
    FLEXION,
    MIDDLES,
    OFFSET,
    aligning,
    applied,
    cross,
    dot,
)

SHOULDERS, ELBOWS, WRISTS = (slice(left, right + 1) for left, right, *_ in (BASES, MIDDLES, ENDS))
"""The joints of both arms, which are the body's last ones, and follow each other."""
BEGINNING, ENDING = slice(SHOULDERS.start, ELBOWS.stop), slice(ELBOWS.start, WRISTS.stop)
"""Where the arms' bones begin and end: the upper ones, then the lower ones."""
SLACK = 1e-3  # the part of its reach by which an arm is never quite straight, nor folded: so it has a side


def reached(rotations: Tensor, joints: Tensor, sparse: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Bend the arms of a body so that its wrists come to their trackers, as far as the arms reach.

    The elbows stay on that side of the line from shoulder to hand on which they are; of a straight arm the
    elbow's axis of flexion tells the side. The bones are turned the least way, and head and wrists as their
    trackers are.

    Args:
        rotations: global rotations (..., 22, 3, 3), world.
        joints: positions (..., 22, 3), metres, world, the head on its tracker.
        sparse: inputs (..., 54), world.
        rest: rest positions (22, 3), metres.

    Returns:
        Rotations and positions of the body with its arms bent.
    """
    tracked = sixd_to_matrix(sparse[..., SPARSE_ROTATION].unflatten(-1, (3, 6)))
    hands = sparse[..., SPARSE_POSITION].unflatten(-1, (3, 3))[..., 1:, :]
    shoulder, elbow = (joints[..., part, :] for part in (SHOULDERS, ELBOWS))
    lengths = (rest[ENDING] - rest[BEGINNING]).norm(dim=-1, keepdim=True)
    side = applied(rotations[..., SHOULDERS, :, :], rest.new_tensor(FLEXION[:2]))
    bent, end = bent_to(hands - shoulder, elbow - shoulder, side, *lengths.split(2))
    before = (joints[..., ENDING, :] - joints[..., BEGINNING, :]) / lengths
    after = torch.cat([bent, end - bent], -2) / lengths
    arms = aligning(before, after) @ rotations[..., BEGINNING, :, :]
    turned = [rotations[..., :HEAD, :, :], tracked[..., :1, :, :], arms, tracked[..., 1:, :, :]]
    placed = [joints[..., : ELBOWS.start, :], shoulder + bent, shoulder + end]
    return torch.cat(turned, -3), torch.cat(placed, -2)


def bent_to(
    goal: Tensor, elbow: Tensor, flexion: Tensor, upper: Tensor, lower: Tensor
) -> tuple[Tensor, Tensor]:
    """Return where elbows and ends of arms are that reach to a goal, all seen from the shoulders.

    Args:
        goal: where the ends should be (..., 2, 3), metres.
        elbow: where the elbows are (..., 2, 3).
        flexion: unit axes of flexion (..., 2, 3), which tell an elbow's side where it has none.
        upper: lengths of the upper bones (2, 1).
        lower: lengths of the lower ones (2, 1).
    """
    distance = goal.norm(dim=-1, keepdim=True).clamp_min(1e-4)
    axis = goal / distance
    most, least = (upper + lower) * (1 - SLACK), (upper - lower).abs() + upper * SLACK
    reach = distance.minimum(most).maximum(least)
    cosine = (upper.square() + reach.square() - lower.square()) / (2 * upper * reach)
    sine = ((1 - cosine) * (1 + cosine)).clamp_min(1e-9).sqrt()
    side = F.normalize(elbow - dot(elbow, axis) * axis + OFFSET * cross(axis, flexion), dim=-1)
    return upper * (cosine * axis + sine * side), reach * axis
