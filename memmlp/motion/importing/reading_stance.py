"""The stance of a file: a pose in which the person is known to stand, from which its skeleton is read.

A zero pose may be a T-pose, or a pose that no standing person has: bones along one axis, a folded body, a
person who lies. Then a frame of the motion is used, or rotations that the skeleton map gives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.importing import anatomy
from memmlp.motion.importing.mapped_motion import MappedMotion
from memmlp.motion.importing.motion_file import MotionFile
from memmlp.motion.importing.skeleton_map import SkeletonMap

STRAIGHTEST = "the straightest"  # how a frame was chosen, beside a given one
TRIED = 500  # frames of a file, evenly spread, among which a stance is looked for


@dataclass(frozen=True)
class Stance:
    """A stance, turned so that the person faces +Z (Y up, metres).

    Attributes:
        rotations: global rotations (22, 3, 3) of the mapped joints' nodes.
        positions: their positions (22, 3).
        source: where the pose is from, in words.
        straight: whether it is a zero pose, whose limbs are assumed to have no twist.
    """

    rotations: np.ndarray
    positions: np.ndarray
    source: str
    straight: bool


def find_stance(recording: MotionFile, skeleton: SkeletonMap, mapped_motion: MappedMotion) -> Stance:
    """Find the stance of a file: the map's, else the zero pose, else the straightest frame.

    Raises:
        InputError: if there is no such pose, or left and right contradict each other in it.
    """
    if isinstance(skeleton.rest, dict):
        return _given(recording, skeleton, mapped_motion)
    if skeleton.rest != "auto":
        return _frame(mapped_motion, _checked_frame(mapped_motion, int(skeleton.rest)), "given")
    why = anatomy.why_no_stance(mapped_motion.zero)
    if why is None:
        eyes = np.tile(np.eye(3), (len(mapped_motion.zero), 1, 1))
        stance = _turned(eyes, mapped_motion.zero, "the zero pose", straight=True)
        _check_sides(mapped_motion, stance)
        if not anatomy.arms_lifted(stance.positions):
            return stance
        why = "an arm is more than 100 degrees from a T-pose's"
    return _straightest(mapped_motion, why)


def _given(recording: MotionFile, skeleton: SkeletonMap, mapped_motion: MappedMotion) -> Stance:
    """Return the stance whose joints have the map's rotations."""
    assert isinstance(skeleton.rest, dict)
    rotations, positions = (array[mapped_motion.nodes] for array in recording.posed(skeleton.rest))
    upright = skeleton.upright
    pose = skeleton.unit * positions @ upright.T
    stance = _turned(upright @ rotations @ upright.T, pose, "the map's rest pose", straight=False)
    why = anatomy.why_no_stance(stance.positions)
    if why is not None:
        wrong = f"rest of skeleton {skeleton.name} is no person who stands: {why}"
        raise InputError(f"{recording.path}: {wrong}; allowed: rotations of a stance")
    _check_sides(mapped_motion, stance)
    return stance


def _straightest(mapped_motion: MappedMotion, why: str) -> Stance:
    """Return the frame in which the person stands straightest; `why` is what is wrong with the zero pose."""
    frames = np.unique(np.linspace(0, len(mapped_motion) - 1, TRIED).astype(int))
    order = frames[np.argsort(anatomy.unevenness(mapped_motion.positions[frames]), kind="stable")]
    stances = [int(frame) for frame in order if anatomy.why_no_stance(mapped_motion.positions[frame]) is None]
    for frame in stances:
        if anatomy.wrong_sides(mapped_motion.positions[frame], mapped_motion.mapped) is None:
            return _frame(mapped_motion, frame, STRAIGHTEST)
    if stances:
        return _frame(mapped_motion, stances[0], STRAIGHTEST)  # which says what is wrong
    best = anatomy.why_no_stance(mapped_motion.positions[order[0]])
    wrong = f"the person stands neither in the zero pose ({why}) nor in any frame (at best, {best})"
    raise InputError(
        f"{mapped_motion.path}: {wrong}; allowed: another up or joints, or rest, in the skeleton's map"
    )


def _frame(mapped_motion: MappedMotion, frame: int, how: str) -> Stance:
    pose, rotations = mapped_motion.positions[frame], mapped_motion.rotations[frame]
    stance = _turned(rotations, pose, f"frame {frame}, {how}", straight=False)
    _check_sides(mapped_motion, stance)
    return stance


def _checked_frame(mapped_motion: MappedMotion, frame: int) -> int:
    """Return the frame's number if the person stands in it; raise InputError otherwise."""
    if not 0 <= frame < len(mapped_motion):
        raise InputError(
            f"{mapped_motion.path}: no frame {frame} for rest; allowed: 0 to {len(mapped_motion) - 1}"
        )
    why = anatomy.why_no_stance(mapped_motion.positions[frame])
    if why is not None:
        raise InputError(
            f"{mapped_motion.path}: rest: frame {frame}: {why}; allowed: a frame of a person who stands"
        )
    return frame


def _turned(rotations: np.ndarray, positions: np.ndarray, source: str, straight: bool) -> Stance:
    """Turn a stance about the vertical to face +Z."""
    turn = anatomy.facing(positions)
    return Stance(turn @ rotations, positions @ turn.T, source, straight)


def _check_sides(mapped_motion: MappedMotion, stance: Stance) -> None:
    why = anatomy.wrong_sides(stance.positions, mapped_motion.mapped)
    if why is not None:
        allowed = "a map with left on the left, and the file's true up axis"
        raise InputError(f"{mapped_motion.path}: in {stance.source}, {why}; allowed: {allowed}")
