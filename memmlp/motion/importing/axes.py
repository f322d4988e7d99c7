"""A recording's unit and up axis: given by its skeleton map, or found from the person in it.

Up is the direction of the head in the zero pose, if that is a person who stands, whoever lies in the motion.
If the motion has the head along the other axis, it can mean two things: a person who lies all the time, or
one who walks while the root's rotation alone has the other axis up. Then the user has to say which.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.body import HEAD, JOINTS
from memmlp.motion.importing.anatomy import LEGS, why_no_stance
from memmlp.motion.importing.motion_file import MotionFile
from memmlp.motion.importing.skeleton_map import REQUIRED, UPRIGHT, SkeletonMap

UNITS = (1.0, 0.1, 0.0254 / 0.45, 0.0254, 0.01, 0.001)  # metres; 0.0254 / 0.45 is CMU's inch
LEG = (0.55, 1.15)  # metres from hip to ankle, by which a unit is found
TOLD_LEG = (0.3, 1.5)  # metres that a told unit may give: children, giants
TELL = "--up y or z, or up in the skeleton's map"
MOST_UPRIGHT = 0.5  # how much of the way from pelvis to head lies along the up axis on average, to be found


def with_unit_and_up(recording: MotionFile, skeleton: SkeletonMap) -> SkeletonMap:
    """Return the map with unit and up axis filled in from the recording, where the map leaves them open.

    Raises:
        InputError: if they can't be found, or if a given unit makes the legs no person's.
    """
    at = {
        joint: recording.nodes.index(node)
        for joint, node in skeleton.joints.items()
        if node in recording.nodes
    }
    if not {JOINTS[joint] for joint in (0, HEAD, *LEGS, *LEGS.values())} <= set(at):
        return skeleton  # what is missing is said where the joints are picked
    positions = recording.kinematics()[1][int(skeleton.calibration_frame) :]
    if len(positions) == 0:
        return skeleton
    return replace(
        skeleton,
        up=skeleton.up or _up(recording, positions[:, at["head"]] - positions[:, at["pelvis"]], at),
        unit=_unit(recording, skeleton, _leg(positions, at)),
    )


def _leg(positions: np.ndarray, at: dict[str, int]) -> float:
    """Return the length from hip to ankle, the mean of both sides, in the file's unit."""
    bones = [positions[:, at[JOINTS[end]]] - positions[:, at[JOINTS[start]]] for start, end in LEGS.items()]
    return float(sum(np.linalg.norm(bone, axis=-1).mean() for bone in bones) / 2)


def _unit(recording: MotionFile, skeleton: SkeletonMap, leg: float) -> float:
    """Return the unit, metres, of a file whose legs have the given length."""
    if skeleton.unit is not None:
        low, high = TOLD_LEG
        if not low <= leg * skeleton.unit <= high:
            wrong = f"legs of {leg * skeleton.unit:.3g} m with the unit {skeleton.unit:g} of {skeleton.name}"
            raise InputError(f"{recording.path}: {wrong}; allowed: a unit that gives {low:g} to {high:g} m")
        return skeleton.unit
    fitting = [unit for unit in UNITS if LEG[0] <= leg * unit <= LEG[1]]
    if not fitting:
        known = ", ".join(f"{unit:.4g}" for unit in UNITS)
        wrong = f"legs of {leg:.3g} in the file's unit, which fits none of {known} m"
        raise InputError(f"{recording.path}: {wrong}; allowed: unit in the skeleton's map")
    return min(fitting, key=lambda unit: abs(leg * unit - 0.85))


def _up(recording: MotionFile, trunk: np.ndarray, at: dict[str, int]) -> str:
    """Return the axis, `y` or `z`, that is up in a file, from the vectors from pelvis to head (N, 3)."""
    mean = (trunk / np.linalg.norm(trunk, axis=-1, keepdims=True).clip(1e-9)).mean(0)
    along = dict(zip("yz", mean[1:].tolist(), strict=True))
    moving = max(along, key=lambda axis: along[axis])
    standing = _standing(recording, at)
    if along[moving] >= MOST_UPRIGHT and standing in (None, moving):
        return moving
    if standing is None or along[standing] <= -MOST_UPRIGHT:
        wrong = f"the head is along ({mean[0]:.2f}, {mean[1]:.2f}, {mean[2]:.2f}) from the pelvis on average"
        raise InputError(f"{recording.path}: {wrong}, so no up axis is found; allowed: {TELL}")
    if along[moving] >= MOST_UPRIGHT:
        wrong = f"the person stands along {standing} in the zero pose, but along {moving} in the motion"
        either = f"--up {standing} if the person lies, else --up {moving}"
        raise InputError(f"{recording.path}: {wrong}; allowed: {TELL}: {either}")
    return standing


def _standing(recording: MotionFile, at: dict[str, int]) -> str | None:
    """Return the axis along which the person stands in the zero pose; None if the pose is no stance."""
    if not set(REQUIRED) <= set(at):
        return None
    zero, pose = recording.zero_pose(), np.zeros((len(JOINTS), 3))
    for joint, node in at.items():
        pose[JOINTS.index(joint)] = zero[node]
    turned = {axis: pose @ rotation.T for axis, rotation in UPRIGHT.items()}
    return next((axis for axis in turned if why_no_stance(turned[axis]) is None), None)
