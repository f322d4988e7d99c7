"""Checks an import: compares a clip with its recording, and with human anatomy. The constants of the
conversion are not used: forward kinematics poses the clip, and the positions to compare come directly from
the file."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.motion.body import HEAD, JOINTS, PARENTS
from memmlp.motion.clip import Clip
from memmlp.motion.geometry import compute_clip_kinematics
from memmlp.motion.importing.anatomy import (
    HINGES,
    HIPS,
    LEG_LENGTH,
    LIMBS,
    SHOULDERS,
    compute_angles,
    find_hinge_axis,
    list_segments,
)
from memmlp.motion.importing.skeleton_map import Z_UP, MappedMotion
from memmlp.motion.plausibility import explain_implausibility, find_faults

MOST_MM, MOST_DEGREES = 1.0, 3.0  # maximum errors of a valid import
SHORTEST = 1e-2  # metres: directions of shorter segments are ignored
LENGTHS = (0.5, 2.0)  # range of a limb's length relative to the legs, divided by this ratio on the body
CHEST, HEAD_TURN = 9, 110.0  # degrees: no neck turns farther
HEAD_SHARE = 0.01  # fraction of the frames that may exceed HEAD_TURN
TORSO, TURN = (3, 6, 9, 12, 13, 14, 15), 60.0  # from spine to head; maximum degrees relative to the parent
TWIST = 45.0  # degrees: maximum deviation of a knee's or elbow's axis from the body's axis
SIDES = 1.1  # maximum ratio of the lengths of left and right limbs
STRETCH = 0.02  # metres: maximum change of a segment's length


class LargestError(NamedTuple):
    """The largest of several errors, the name of its joint or segment, and the index of its frame."""

    value: float
    where: str
    frame: int

    def __str__(self) -> str:
        return f"{self.where}, frame {self.frame}"


@dataclass(frozen=True)
class Fidelity:
    """The deviations between an import and its file, given by its path below the folder: the maximum
    distance, millimetres, between a joint in the file and in the import, posed with the bone lengths in the
    file; the maximum angle, degrees, between the directions of a segment on the body and in the file; and the
    clip's likely mistakes, one sentence each."""

    name: str
    skeleton: str
    frames: int
    mm: LargestError
    degrees: LargestError
    faults: tuple[str, ...]


def compare_with_recording(clip: Clip, motion: MappedMotion, rest: np.ndarray, skeleton: str) -> Fidelity:
    """Compare a clip on a body with rest joints (22, 3), metres, with the mapped motion from which it was
    made. `skeleton` is the name of its map."""
    rotations, positions = compute_clip_kinematics(clip, rest)
    expected, mapped = motion.positions @ Z_UP.T, motion.mapped
    mm = _measure_distance(rotations, expected, mapped)
    degrees = _measure_deviation(positions, expected, mapped)
    impossible = explain_implausibility(clip)
    faults = (
        *_find_map_faults(mm, degrees, expected, mapped),
        *_find_hip_faults(motion),
        *_find_turn_faults(rotations, positions),
        *_find_length_faults(expected, rest),
        *([impossible] if impossible else find_faults(clip)),
    )
    return Fidelity(clip.name, skeleton, len(clip), mm, degrees, faults)


def _measure_distance(rotations: np.ndarray, expected: np.ndarray, mapped: np.ndarray) -> LargestError:
    """Measure the maximum distance, mm, between joints in the file and joints from a clip's rotations. In its
    parent joint's frame, each bone has a constant direction, which is its mean over all frames. So a distance
    arises if the clip's rotations differ from the file's."""
    posed = expected.copy()
    for joint in np.flatnonzero(mapped)[1:]:
        parent = PARENTS[joint]
        while not mapped[parent]:
            parent = PARENTS[parent]
        bone = expected[:, joint] - expected[:, parent]
        length = np.linalg.norm(bone, axis=-1, keepdims=True)
        local_bone = np.einsum("nij,ni->nj", rotations[:, parent], bone).mean(0)
        size = np.linalg.norm(local_bone)
        posed_bone = rotations[:, parent] @ (local_bone / size) * length if size > 1e-9 else bone
        posed[:, joint] = posed[:, parent] + posed_bone
    return _find_largest_error(1000 * np.linalg.norm(posed - expected, axis=-1), JOINTS)


def _measure_deviation(positions: np.ndarray, expected: np.ndarray, mapped: np.ndarray) -> LargestError:
    """Measure the maximum angle, degrees, between segments on the body and in the file."""
    named = {str(segment): (segment.start, segment.end) for segment in list_segments(mapped)}
    named |= {"right_hip to left_hip": HIPS[::-1]}
    off = np.zeros((len(positions), len(named)))
    for column, (start, end) in enumerate(named.values()):
        there = expected[:, end] - expected[:, start]
        long = np.linalg.norm(there, axis=-1) > SHORTEST
        off[:, column] = np.where(long, compute_angles(positions[:, end] - positions[:, start], there), 0.0)
    return _find_largest_error(off, list(named))


def _find_largest_error(errors: np.ndarray, names: list[str] | tuple[str, ...]) -> LargestError:
    frame, column = np.unravel_index(int(errors.argmax()), errors.shape)
    return LargestError(float(errors[frame, column]), names[column], int(frame))


# Likely mistakes, one sentence each


def _find_map_faults(
    mm: LargestError, degrees: LargestError, expected: np.ndarray, mapped: np.ndarray
) -> Iterator[str]:
    if mm.value > MOST_MM:
        yield f"{mm.where} deviates by {mm.value:.1f} mm from the file in frame {mm.frame}"
    if degrees.value > MOST_DEGREES:
        deviation = f"{degrees.value:.1f} degrees from the file"
        yield f"{degrees.where} deviates by {deviation} in frame {degrees.frame}"
    for segment in list_segments(mapped):
        lengths = np.linalg.norm(expected[:, segment.end] - expected[:, segment.start], axis=-1)
        if np.ptp(lengths) > STRETCH:
            frame = int(np.abs(lengths - np.median(lengths)).argmax())
            change = f"{segment} changes its length by {1000 * np.ptp(lengths):.0f} mm in the file"
            yield f"{change} (most in frame {frame}), so an unmapped joint turns, or the map is wrong"


def _find_hip_faults(motion: MappedMotion) -> Iterator[str]:
    for hip in HIPS:
        offset = motion.positions[:, hip] - motion.positions[:, 0]
        local = np.einsum("nij,ni->nj", motion.rotations[:, 0], offset)
        moved = np.linalg.norm(local - (motion.zero[hip] - motion.zero[0]), axis=-1)
        if moved.max() > STRETCH:
            far = f"{JOINTS[hip]} moves relative to the pelvis by {1000 * moved.max():.0f} mm"
            where = f"in frame {moved.argmax()}"
            yield f"{far} {where}, so a joint between them turns, or the file is from another program"


def _find_turn_faults(rotations: np.ndarray, positions: np.ndarray) -> Iterator[str]:
    turns = [compute_angles(rotations[:, HEAD, :, axis], rotations[:, CHEST, :, axis]) for axis in (1, 2)]
    odd = np.max(turns, axis=0) > HEAD_TURN
    if odd.mean() > HEAD_SHARE:
        turned = f"the head is rotated by more than {HEAD_TURN:.0f} degrees relative to the chest"
        yield f"{turned} in {odd.mean():.0%} of the frames, first in frame {odd.argmax()}"
    for joint in TORSO:
        own = rotations[:, PARENTS[joint]].swapaxes(-1, -2) @ rotations[:, joint]
        turn = np.degrees(np.median(Rotation.from_matrix(own).magnitude()))
        if turn > TURN:
            size = f"{turn:.0f} degrees relative to {JOINTS[PARENTS[joint]]} in half of the frames"
            yield f"{JOINTS[joint]} is rotated by {size}, so rest, the zero pose or the map is wrong"
    for joint, body_axis in HINGES.items():
        axis = find_hinge_axis(rotations[:, joint], positions, joint)
        off = 0.0 if axis is None else compute_angles(axis, np.array(body_axis))
        if off > TWIST:
            bend = f"bends about an axis that deviates by {off:.0f} degrees"
            yield f"{JOINTS[LIMBS[joint]]} {bend}, so the limb is twisted in rest or in the zero pose"


def _find_length_faults(expected: np.ndarray, rest: np.ndarray) -> Iterator[str]:
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
            yield f"{name} is {both[0]:.2f} m long, but {both[1]:.2f} m on the right side"
    for start, end in (*LIMBS.items(), (0, HEAD), SHOULDERS):
        ratio = length(expected, start, end) / legs(expected) * legs(rest) / length(rest, start, end)
        if not LENGTHS[0] <= ratio <= LENGTHS[1]:
            name = f"{JOINTS[start]} to {JOINTS[end]}"
            yield f"{name} is {ratio:.2f} times as long as expected for the length of the legs"
