"""Closed-form solutions for arms and legs, from MANIKIN (Jiang et al., ECCV 2024).

A limb has a base (shoulder, hip), a middle (elbow, knee) and an end (wrist, ankle). For a given base and end,
the middle lies on a circle; the **swivel** is its angle on that circle. Each elbow and knee bends about one
axis.

The order of the four limbs in tensors is left arm, right arm, left leg, right leg.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from memmlp.motion.body import HEAD, PARENTS, SPARSE_POSITION, SPARSE_ROTATION
from memmlp.motion.geometry import matrix_to_wxyz
from memmlp.networks.layers import replace_joints, select_joints

BASES, MIDDLES, ENDS = (16, 17, 1, 2), (18, 19, 4, 5), (20, 21, 7, 8)
ANKLES, TOES = ENDS[2:], (10, 11)
FLEXION = ((0.189, -0.966, 0.179), (0.085, 0.970, -0.227), (0.985, 0.003, -0.174), (0.995, -0.029, 0.096))
"""The rotation axes of elbows and knees in the rest pose, as published for SMPL bodies."""
MAX_TWIST = (90.0, 90.0, 40.0, 40.0)
"""The maximum twist of shoulders and hips about their upper bone, in degrees, in both directions."""
SKEW = ((0, 0, 0, 0, 0, -1, 0, 1, 0), (0, 0, 1, 0, 0, 0, -1, 0, 0), (0, -1, 0, 1, 0, 0, 0, 0, 0))
"""The contribution of each vector component to the 3 x 3 cross-product matrix, row by row."""
IDENTITY = ((1.0, 0, 0), (0, 1, 0), (0, 0, 1))
# From 1, of the cosine of the least bend, 1.8 degrees: on a straighter limb rounding is visible.
STRAIGHT_MARGIN = 5e-4
OFFSET = 1e-3  # metres; which way a limb bends that is straighter than that follows from its axis of flexion


def dot(one: Tensor, other: Tensor) -> Tensor:
    """Return the dot products (..., 1) of vectors (..., 3)."""
    return (one * other).sum(-1, keepdim=True)


def make_cross_matrices(vector: Tensor) -> Tensor:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    return (vector @ vector.new_tensor(SKEW)).unflatten(-1, (3, 3))


def cross(one: Tensor, other: Tensor) -> Tensor:
    """Return the cross products (..., 3) of vectors (..., 3)."""
    return rotate(make_cross_matrices(one), other)


def rotate(rotation: Tensor, vector: Tensor) -> Tensor:
    """Apply rotations (..., 3, 3) to vectors (..., 3)."""
    return (rotation @ vector[..., None])[..., 0]


def make_axis_rotations(axis: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Return the rotations (..., 3, 3) about unit axes (..., 3), given the cosine and sine (..., 1)."""
    across, identity = make_cross_matrices(axis), axis.new_tensor(IDENTITY)
    return identity + sine[..., None] * across + (1 - cosine)[..., None] * (across @ across)


def find_aligning_rotations(start: Tensor, goal: Tensor) -> Tensor:
    """Return the smallest rotations (..., 3, 3) from unit vectors `start` to unit vectors `goal` (..., 3)."""
    across, identity = make_cross_matrices(cross(start, goal)), goal.new_tensor(IDENTITY)
    return identity + across + across @ across / (1 + dot(start, goal)).clamp_min(1e-6)[..., None]


def build_frame(first: Tensor, second: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) with two perpendicular unit vectors and their cross product as columns."""
    return torch.stack([first, second, cross(first, second)], -1)


def find_swivel_directions(axis: Tensor, up: Tensor) -> tuple[Tensor, Tensor]:
    """Return the directions (..., 3) for swivels of 0 and of 90 degrees.

    Args:
        axis: unit vectors (..., 3) from base to end.
        up: the bases' Y axes (..., 3).
    """
    start = F.normalize(dot(up, axis) * axis - up, dim=-1)
    return start, cross(start, axis)


def measure_swivels(base: Tensor, middle: Tensor, end: Tensor, up: Tensor) -> Tensor:
    """Return swivels (..., 2), cosine and sine, for limb joints (..., 3) and the bases' Y axes `up`."""
    axis = F.normalize(end - base, dim=-1)
    start, quarter = find_swivel_directions(axis, up)
    away = middle - base
    return F.normalize(torch.cat([dot(away, start), dot(away, quarter)], -1), dim=-1)


def find_bend_direction(axis: Tensor, up: Tensor, swivel: Tensor) -> Tensor:
    """Return unit vectors (..., 3) from the axis to the middle, for swivels (..., 2), cosine and sine."""
    start, quarter = find_swivel_directions(axis, up)
    return swivel[..., :1] * start + swivel[..., 1:] * quarter


def place_middle(
    base: Tensor, end: Tensor, up: Tensor, swivel: Tensor, upper: Tensor, lower: Tensor
) -> Tensor:
    """Return the positions of the limbs' middle joints (..., 3), metres.

    Args:
        base, end: positions of the limbs' bases and ends (..., 3), metres.
        up: the bases' Y axes (..., 3).
        swivel: cosines and sines (..., 2) of the swivels.
        upper, lower: lengths of the bones (..., 1), metres.
    """
    away = end - base
    reach = away.norm(dim=-1, keepdim=True).clamp_min(1e-4)
    axis = away / reach
    cosine = ((upper.square() + reach.square() - lower.square()) / (2 * upper * reach)).clamp(-1, 1)
    sine = (1 - cosine.square()).clamp_min(1e-6).sqrt()
    return base + upper * (cosine * axis + sine * find_bend_direction(axis, up, swivel))


def find_bones(rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the limbs' upper and lower bones (4, 3) and axes of flexion (4, 3) in a rest pose (22, 3)."""
    base, middle, end = (rest[list(joints)] for joints in (BASES, MIDDLES, ENDS))
    return middle - base, end - middle, F.normalize(rest.new_tensor(FLEXION), dim=-1)


def bend_middles(upper: Tensor, lower: Tensor, axis: Tensor, reach: Tensor) -> Tensor:
    """Return the rotations (..., 4, 3, 3) of elbows and knees for given distances from base to end.

    Each limb bends in the direction of its flexion axis. If a distance is out of range, the limb is as
    straight or as bent as possible.

    Args:
        upper, lower, axis: see `find_bones`.
        reach: the distances from base to end (..., 4, 1), metres.
    """
    along = dot(upper, axis) * dot(lower, axis)
    cosine, sine = dot(upper, lower) - along, dot(upper, cross(axis, lower))
    size = (cosine.square() + sine.square()).sqrt()
    needed_product = (reach.square() - dot(upper, upper) - dot(lower, lower)) / 2 - along
    bend = (needed_product / size).clamp(-1 + STRAIGHT_MARGIN, 1 - STRAIGHT_MARGIN)
    across, cosine, sine = ((1 - bend) * (1 + bend)).sqrt(), cosine / size, sine / size
    axes = axis.expand(*bend.shape[:-1], 3)
    return make_axis_rotations(axes, cosine * bend - sine * across, sine * bend + cosine * across)


def measure_twist(rotation: Tensor, axis: Tensor) -> tuple[Tensor, Tensor]:
    """Return cosine and sine (..., 1) of the twist of rotations (..., 3, 3) about an axis.

    Args:
        rotation: rotations (..., 3, 3).
        axis: unit vectors (..., 3).
    """
    flat = rotation.flatten(-2)
    turned, trace = flat @ flat.new_tensor(SKEW).T, flat @ flat.new_tensor(IDENTITY).flatten()[:, None]
    both = torch.cat([trace - dot(axis, rotate(rotation, axis)), dot(axis, turned)], -1)
    cosine, sine = F.normalize(both, dim=-1).split(1, -1)
    return cosine, sine


def limit_twist(local: Tensor, bone: Tensor, axis: Tensor) -> Tensor:
    """Return the smallest rotations (..., 4, 3, 3) about the limbs' axes that limit the bases' twists.

    A base within its limits is not rotated. Otherwise let h be half of the rotation's angle: the rotated
    base's twist is a ratio of sums of sin h and cos h, which gives tan h.

    Args:
        local: the bases' local rotations (..., 4, 3, 3).
        bone: the upper bones' unit vectors (4, 3) in the rest pose.
        axis: the unit vectors (..., 4, 3) from base to end, in the frames of the bases' parents.
    """
    real, vector = matrix_to_wxyz(local).split([1, 3], -1)
    limit = (local.new_tensor(MAX_TWIST) * (math.pi / 360)).tan()[:, None]
    turned = dot(vector, bone)
    by_sine = real * dot(axis, bone) + dot(cross(axis, vector), bone)
    tangents = []
    for bound in (limit, -limit):
        share = by_sine + bound * dot(axis, vector)
        tangents.append((bound * real - turned) / torch.where(share.abs() < 1e-9, 1e-9, share))
    nearest = torch.where(tangents[0].abs() < tangents[1].abs(), tangents[0], tangents[1])
    half = torch.where(turned.abs() > limit * real, nearest, 0.0)
    size = 1 + half.square()
    return make_axis_rotations(axis, 2 / size - 1, 2 * half / size)


def solve_limbs(
    local: Tensor,
    turned: Tensor,
    base: Tensor,
    end: Tensor,
    swivel: Tensor,
    hands: Tensor,
    toe: Tensor,
    rest: Tensor,
) -> Tensor:
    """Return the local rotations (..., 22, 3, 3) of a body with its limbs solved.

    Wrists and ankles are placed at their given positions within the limbs' reach. A hand's rotation about its
    forearm goes to the elbow, its remaining rotation to the wrist. A foot takes the smallest rotation to its
    toe.

    Args:
        local: local rotations (..., 22, 3, 3); the limbs' rotations are ignored.
        turned: global rotations (..., 22, 3, 3) of the same body.
        base: positions (..., 4, 3) of shoulders and hips, metres.
        end: positions (..., 4, 3) of wrists and ankles.
        swivel: cosines and sines (..., 4, 2).
        hands: global rotations (..., 2, 3, 3) of the wrists.
        toe: vectors (..., 2, 3) from the ankles to the toes, of any length.
        rest: rest positions (22, 3), metres.
    """
    upper, lower, flexion = find_bones(rest)
    away = end - base
    bent = bend_middles(upper, lower, flexion, away.norm(dim=-1, keepdim=True))
    back = select_joints(turned, [PARENTS[joint] for joint in BASES], -3).transpose(-1, -2)
    axis = F.normalize(away, dim=-1)
    direction = find_bend_direction(axis, select_joints(turned[..., 1], BASES), swivel)
    # Before a base is turned, its end lies along `chain`, and its middle to the side of that line.
    chain = F.normalize(upper + rotate(bent, lower), dim=-1)
    side = upper + OFFSET * cross(chain, flexion)
    unturned = build_frame(chain, F.normalize(side - dot(side, chain) * chain, dim=-1))
    bases = back @ build_frame(axis, direction) @ unturned.transpose(-1, -2)
    bases = limit_twist(bases, F.normalize(upper, dim=-1), rotate(back, axis)) @ bases
    arms, shins = (back.transpose(-1, -2) @ bases @ bent).split(2, -3)
    seen = arms.transpose(-1, -2) @ hands
    forearm = F.normalize(lower[:2], dim=-1).expand(*seen.shape[:-2], 3)
    rolled = make_axis_rotations(forearm, *measure_twist(seen, forearm))
    wrists = rolled.transpose(-1, -2) @ seen
    goal = rotate(shins.transpose(-1, -2), F.normalize(toe, dim=-1))
    foot = F.normalize(rest[list(TOES)] - rest[list(ANKLES)], dim=-1).expand(goal.shape)
    ankles = find_aligning_rotations(foot, goal)
    limbs = torch.cat([bases, bent[..., :2, :, :] @ rolled, bent[..., 2:, :, :], wrists, ankles], -3)
    return replace_joints(local, (*BASES, *MIDDLES, *ENDS), limbs, -3)


SHOULDERS, ELBOWS, WRISTS = (slice(left, right + 1) for left, right, *_ in (BASES, MIDDLES, ENDS))
"""The joints of both arms, which are the body's last joints, as slices."""
BONE_STARTS, BONE_ENDS = slice(SHOULDERS.start, ELBOWS.stop), slice(ELBOWS.start, WRISTS.stop)
"""The joints where the arms' bones begin and end: upper bones, then lower bones."""
# The part of its reach by which an arm is never quite straight, nor folded: so it has a side.
REACH_MARGIN = 1e-3


def use_tracker_rotations(rotations: Tensor, sparse: Tensor) -> Tensor:
    """Replace the rotations of head and wrists by their trackers' rotations.

    Args:
        rotations: global rotations (..., 132), 6D, world.
        sparse: inputs (..., 54), world.
    """
    seen = sparse[..., SPARSE_ROTATION]
    head, wrists = 6 * HEAD, 6 * WRISTS.start
    return torch.cat(
        [rotations[..., :head], seen[..., :6], rotations[..., head + 6 : wrists], seen[..., 6:]], -1
    )


def bend_arms_to_trackers(
    rotations: Tensor, joints: Tensor, sparse: Tensor, rest: Tensor
) -> tuple[Tensor, Tensor]:
    """Bend a body's arms so that its wrists meet their trackers, within the arms' reach.

    Each elbow stays on its side of the line from shoulder to hand. The elbow of a straight arm moves towards
    the back of the upper arm. The bones take the smallest possible rotations.

    Args:
        rotations: global rotations (..., 22, 3, 3), world.
        joints: positions (..., 22, 3), metres, world, the head on its tracker.
        sparse: inputs (..., 54), world.
        rest: rest positions (22, 3), metres.

    Returns:
        Rotations and positions of the body with its arms bent.
    """
    hands = sparse[..., SPARSE_POSITION].unflatten(-1, (3, 3))[..., 1:, :]
    shoulder, arms = joints[..., SHOULDERS, :], rotations[..., BONE_STARTS, :, :]
    bones = joints[..., BONE_ENDS, :] - joints[..., BONE_STARTS, :]
    lengths = (rest[BONE_ENDS] - rest[BONE_STARTS]).norm(dim=-1, keepdim=True)
    side = bones[..., :2, :] - OFFSET * arms[..., :2, :, 2]  # the upper arms' third axes point to the front
    elbow, wrist = place_elbows_and_wrists(hands - shoulder, side, *lengths.split(2))
    bent = torch.cat([elbow, wrist - elbow], -2)
    arms = find_aligning_rotations(bones / lengths, bent / lengths) @ arms
    turned = [rotations[..., : BONE_STARTS.start, :, :], arms, rotations[..., BONE_STARTS.stop :, :, :]]
    placed = [joints[..., : BONE_ENDS.start, :], shoulder + elbow, shoulder + wrist]
    return torch.cat(turned, -3), torch.cat(placed, -2)


def place_elbows_and_wrists(
    goal: Tensor, side: Tensor, upper: Tensor, lower: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the positions of elbows and wrists relative to the shoulders, for arms that reach for a goal.

    Args:
        goal: target positions of the wrists (..., 2, 3), metres.
        side: directions from the goal's axis towards the elbows (..., 2, 3).
        upper: lengths of the upper bones (2, 1).
        lower: lengths of the lower bones (2, 1).
    """
    distance = goal.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    axis = goal / distance
    most, least = (upper + lower) * (1 - REACH_MARGIN), (upper - lower).abs() + upper * REACH_MARGIN
    reach = distance.minimum(most).maximum(least)
    along = reach / 2 + (upper.square() - lower.square()) / 2 / reach
    out = side - dot(side, axis) * axis
    across = (upper.square() - along.square()).sqrt() / out.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return along * axis + across * out, reach * axis
