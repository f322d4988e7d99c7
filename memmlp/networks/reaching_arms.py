"""Arms that reach to the hands' trackers, in closed form.

If shoulder and wrist are known, the elbow lies on a circle (Tolani et al. 2000). The network's prediction
decides where on that circle; everything else it predicted of the arm is replaced to match the tracker.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from memmlp.motion.body import HEAD, SPARSE_POSITION, SPARSE_ROTATION
from memmlp.networks.baselines.limb_solver import BASES, ENDS, MIDDLES, OFFSET, aligning, dot

SHOULDERS, ELBOWS, WRISTS = (slice(left, right + 1) for left, right, *_ in (BASES, MIDDLES, ENDS))
"""The joints of both arms, which are the body's last ones, and follow each other."""
BEGINNING, ENDING = slice(SHOULDERS.start, ELBOWS.stop), slice(ELBOWS.start, WRISTS.stop)
"""Where the arms' bones begin and end: the upper ones, then the lower ones."""
SLACK = 1e-3  # the part of its reach by which an arm is never quite straight, nor folded: so it has a side


def tracked(rotations: Tensor, sparse: Tensor) -> Tensor:
    """Replace the rotations of head and wrists by those of their trackers.

    Args:
        rotations: global rotations (..., 132), 6D, world.
        sparse: inputs (..., 54), world.
    """
    seen = sparse[..., SPARSE_ROTATION]
    head, wrists = 6 * HEAD, 6 * WRISTS.start
    return torch.cat(
        [rotations[..., :head], seen[..., :6], rotations[..., head + 6 : wrists], seen[..., 6:]], -1
    )


def reached(rotations: Tensor, joints: Tensor, sparse: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Bend the arms of a body so that its wrists get to their trackers, as far as the arms reach.

    Each elbow stays on its side of the line from shoulder to hand; the elbow of a straight arm goes to the
    back of the upper arm. The bones are turned by the smallest rotations.

    Args:
        rotations: global rotations (..., 22, 3, 3), world.
        joints: positions (..., 22, 3), metres, world, the head on its tracker.
        sparse: inputs (..., 54), world.
        rest: rest positions (22, 3), metres.

    Returns:
        Rotations and positions of the body with its arms bent.
    """
    hands = sparse[..., SPARSE_POSITION].unflatten(-1, (3, 3))[..., 1:, :]
    shoulder, arms = joints[..., SHOULDERS, :], rotations[..., BEGINNING, :, :]
    bones = joints[..., ENDING, :] - joints[..., BEGINNING, :]
    lengths = (rest[ENDING] - rest[BEGINNING]).norm(dim=-1, keepdim=True)
    side = bones[..., :2, :] - OFFSET * arms[..., :2, :, 2]  # the upper arms' third axes point to the front
    elbow, wrist = bent_to(hands - shoulder, side, *lengths.split(2))
    bent = torch.cat([elbow, wrist - elbow], -2)
    arms = aligning(bones / lengths, bent / lengths) @ arms
    turned = [rotations[..., : BEGINNING.start, :, :], arms, rotations[..., BEGINNING.stop :, :, :]]
    placed = [joints[..., : ENDING.start, :], shoulder + elbow, shoulder + wrist]
    return torch.cat(turned, -3), torch.cat(placed, -2)


def bent_to(goal: Tensor, side: Tensor, upper: Tensor, lower: Tensor) -> tuple[Tensor, Tensor]:
    """Return the positions of elbows and wrists of arms that reach to a goal, all relative to the shoulders.

    Args:
        goal: where the wrists should be (..., 2, 3), metres.
        side: to which side of the goal the elbows are (..., 2, 3).
        upper: lengths of the upper bones (2, 1).
        lower: lengths of the lower ones (2, 1).
    """
    distance = goal.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    axis = goal / distance
    most, least = (upper + lower) * (1 - SLACK), (upper - lower).abs() + upper * SLACK
    reach = distance.minimum(most).maximum(least)
    cosine = reach / (2 * upper) + (upper.square() - lower.square()) / (2 * upper) / reach
    sine = (1 - cosine.square()).clamp_min(1e-9).sqrt()
    out = F.normalize(side - dot(side, axis) * axis, dim=-1)
    return upper * (cosine * axis + sine * out), reach * axis
