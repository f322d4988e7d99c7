"""The check of an import: a clip is compared with the file that it came from, and with people's anatomy.

Nothing here uses the import's own fit. The clip is posed on the built-in body (or another) by forward
kinematics; the file's joints are taken from the file.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.motion.body import HEAD, JOINTS, PARENTS
from memmlp.motion.clip import Clip
from memmlp.motion.geometry import clip_kinematics
from memmlp.motion.importing.anatomy import (
    HINGES,
    HIPS,
    LEG_LENGTH,
    LIMBS,
    SHOULDERS,
    angles,
    hinge,
    segments,
)
from memmlp.motion.importing.skeleton_map import Z_UP, MappedMotion
from memmlp.motion.plausibility import find_faults, why_implausible

MOST_MM, MOST_DEGREES = 1.0, 3.0  # the largest errors that an import may have
SHORTEST = 1e-2  # metres: the direction of a shorter segment does not count
LENGTHS = (0.5, 2.0)  # of a limb to the legs' length, over the same on the body
CHEST, HEAD_TURN, HEAD_SHARE = 9, 110.0, 0.01  # degrees no neck turns up, down or aside; share of the frames
TORSO, TURN = (3, 6, 9, 12, 13, 14, 15), 60.0  # spine, neck, collars, head; degrees against the joint above
TWIST = 45.0  # degrees by which a knee's or elbow's axis may be off the body's
SIDES = 1.1  # left over right
STRETCH = 0.02  # metres by which a segment may change its length


class Worst(NamedTuple):
    """The largest one of several errors.

    Attributes:
        value: the error.
        where: the joint or segment.
        frame: the frame of the clip.
    """

    value: float
    where: str
    frame: int

    def __str__(self) -> str:
        return f"{self.where}, frame {self.frame}"


@dataclass(frozen=True)
class Fidelity:
    """The deviation of an import from its file, in the worst frame.

    Attributes:
        name: the file's path below the folder.
        skeleton: the map's name.
        frames: number of frames compared.
        mm: largest distance, millimetres, between a joint in the file and in the import posed on the file's
            own bones; a bone has its length in the file at that frame.
        degrees: largest angle, degrees, between the directions of a segment on the body and in the file.
        faults: the clip's faults, one sentence each, as `data verify` and `data import` report them.
    """

    name: str
    skeleton: str
    frames: int
    mm: Worst
    degrees: Worst
    faults: tuple[str, ...]


def compare(clip: Clip, motion: MappedMotion, rest: np.ndarray, skeleton: str) -> Fidelity:
    """Compare a clip on a body, rest joints (22, 3) in metres, with the mapped motion that it came from."""
    rotations, positions = clip_kinematics(clip, rest)
    expected, mapped = motion.positions @ Z_UP.T, motion.mapped
    mm, degrees = _distance(rotations, expected, mapped), _deviation(positions, expected, mapped)
    impossible = why_implausible(clip)
    faults = (
        *_map_faults(mm, degrees, expected, mapped),
        *_turn_faults(rotations, positions),
        *_length_faults(expected, rest),
        *([impossible] if impossible else find_faults(clip)),
    )
    return Fidelity(clip.name, skeleton, len(clip), mm, degrees, faults)


def _distance(rotations: np.ndarray, expected: np.ndarray, mapped: np.ndarray) -> Worst:
    """Return the worst distance, mm, of joints posed by a clip's rotations on the bones of the file.

    A bone has its mean direction over the frames in its joint's frame. So the next joint is elsewhere if
    the rotations do not turn with the file's joints.
    """
    posed = expected.copy()
    for joint in np.flatnonzero(mapped)[1:]:
        parent = PARENTS[joint]
        while not mapped[parent]:
            parent = PARENTS[parent]
        bone = expected[:, joint] - expected[:, parent]
        length = np.linalg.norm(bone, axis=-1, keepdims=True)
        own = np.einsum("nij,ni->nj", rotations[:, parent], bone).mean(0)
        size = np.linalg.norm(own)
        posed_bone = rotations[:, parent] @ (own / size) * length if size > 1e-9 else bone
        posed[:, joint] = posed[:, parent] + posed_bone
    return _worst(1000 * np.linalg.norm(posed - expected, axis=-1), JOINTS)


def _deviation(positions: np.ndarray, expected: np.ndarray, mapped: np.ndarray) -> Worst:
    """Return the worst angle, degrees, between segments on the body and in the file."""
    named = {str(segment): (segment.start, segment.end) for segment in segments(mapped)}
    named |= {"right_hip to left_hip": HIPS[::-1]}
    off = np.zeros((len(positions), len(named)))
    for column, (start, end) in enumerate(named.values()):
        there = expected[:, end] - expected[:, start]
        long = np.linalg.norm(there, axis=-1) > SHORTEST
        off[:, column] = np.where(long, angles(positions[:, end] - positions[:, start], there), 0.0)
    return _worst(off, list(named))


def _worst(errors: np.ndarray, names: list[str] | tuple[str, ...]) -> Worst:
    """Return the largest of errors (N, names)."""
    frame, column = np.unravel_index(int(errors.argmax()), errors.shape)
    return Worst(float(errors[frame, column]), names[column], int(frame))


# Faults, one sentence each


def _map_faults(mm: Worst, degrees: Worst, expected: np.ndarray, mapped: np.ndarray) -> Iterator[str]:
    if mm.value > MOST_MM:
        yield f"{mm.where} is {mm.value:.1f} mm off on the file's own bones in frame {mm.frame}"
    if degrees.value > MOST_DEGREES:
        yield f"{degrees.where} points {degrees.value:.1f} degrees off the file's in frame {degrees.frame}"
    for segment in segments(mapped):
        lengths = np.linalg.norm(expected[:, segment.end] - expected[:, segment.start], axis=-1)
        if np.ptp(lengths) > STRETCH:
            frame = int(np.abs(lengths - np.median(lengths)).argmax())
            change = f"{segment} changes its length by {1000 * np.ptp(lengths):.0f} mm in the file"
            yield f"{change} (most in frame {frame}): a joint between them turns, or the map is wrong"


def _turn_faults(rotations: np.ndarray, positions: np.ndarray) -> Iterator[str]:
    """Yield the joints that are turned further than any person's, and limbs that are twisted."""
    turns = [angles(rotations[:, HEAD, :, axis], rotations[:, CHEST, :, axis]) for axis in (1, 2)]
    odd = np.max(turns, axis=0) > HEAD_TURN
    if odd.mean() > HEAD_SHARE:
        turned = f"the head is turned by more than {HEAD_TURN:.0f} degrees against the chest"
        yield f"{turned} in {odd.mean():.0%} of the frames, first in frame {odd.argmax()}"
    for joint in TORSO:
        own = rotations[:, PARENTS[joint]].swapaxes(-1, -2) @ rotations[:, joint]
        turn = np.degrees(np.median(Rotation.from_matrix(own).magnitude()))
        if turn > TURN:
            against = f"{turn:.0f} degrees against {JOINTS[PARENTS[joint]]} in half of the frames"
            yield f"{JOINTS[joint]} is turned by {against}: rest, the zero pose or the map is wrong"
    for joint, body_axis in HINGES.items():
        axis = hinge(rotations[:, joint], positions, joint)
        off = 0.0 if axis is None else angles(axis, np.array(body_axis))
        if off > TWIST:
            turned = f"bends about an axis {off:.0f} degrees off the body's"
            yield f"{JOINTS[LIMBS[joint]]} {turned}: the limb is twisted in rest or the zero pose"


def _length_faults(expected: np.ndarray, rest: np.ndarray) -> Iterator[str]:
    def length(at: np.ndarray, start: int, end: int) -> float:
        return float(np.median(np.linalg.norm(at[..., end, :] - at[..., start, :], axis=-1)))

    def legs(at: np.ndarray) -> float:
        return sum(length(at, start, LIMBS[start]) for start in (1, 2, 4, 5)) / 2

    if not LEG_LENGTH[0] <= legs(expected) <= LEG_LENGTH[1]:
        yield f"the legs are {legs(expected):.2f} m long, so the unit may be wrong"
    for left, right in ((1, 2), (4, 5), (16, 17), (18, 19)):
        both = [length(expected, start, LIMBS[start]) for start in (left, right)]
        if max(both) > SIDES * min(both):
            name = f"{JOINTS[left]} to {JOINTS[LIMBS[left]]}"
            yield f"{name} is {both[0]:.2f} m and the right one {both[1]:.2f} m"
    for start, end in (*LIMBS.items(), (0, HEAD), SHOULDERS):
        share = length(expected, start, end) / legs(expected) * legs(rest) / length(rest, start, end)
        if not LENGTHS[0] <= share <= LENGTHS[1]:
            name = f"{JOINTS[start]} to {JOINTS[end]}"
            yield f"{name} is {share:.2f} times as long as on a person with such legs"
