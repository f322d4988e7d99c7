"""A recording's unit and up axis: as its skeleton's map tells them, or found from the person in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.body import HEAD, JOINTS
from memmlp.motion.importing.anatomy import LEGS
from memmlp.motion.importing.recording import Recording
from memmlp.motion.importing.skeleton import SkeletonMap

UNITS = (1.0, 0.1, 0.0254 / 0.45, 0.0254, 0.01, 0.001)  # metres; 0.0254 / 0.45 is CMU's inch
LEG = (0.55, 1.15)  # metres from hip to ankle, by which a unit is found
TOLD_LEG = (0.3, 1.5)  # metres that a told unit may give: children, giants
MOST_UPRIGHT = 0.5  # how much of the way from pelvis to head lies along the up axis on average, to be found


def settle(recording: Recording, skeleton: SkeletonMap) -> SkeletonMap:
    """Return the map with the recording's unit and up axis where it leaves them to be found.

    Raises:
        InputError: if they can't be found, or a told unit gives no person's legs.
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
        up=skeleton.up or _up(recording, positions[:, at["head"]] - positions[:, at["pelvis"]]),
        unit=_unit(recording, skeleton, _leg(positions, at)),
    )


def _leg(positions: np.ndarray, at: dict[str, int]) -> float:
    """Return the length from hip to ankle, the mean of both sides, in the file's unit."""
    bones = [positions[:, at[JOINTS[end]]] - positions[:, at[JOINTS[start]]] for start, end in LEGS.items()]
    return float(sum(np.linalg.norm(bone, axis=-1).mean() for bone in bones) / 2)


def _unit(recording: Recording, skeleton: SkeletonMap, leg: float) -> float:
    """Return the unit, metres, of a file with legs of that length."""
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


def _up(recording: Recording, trunk: np.ndarray) -> str:
    """Return the axis, `y` or `z`, along which the way from pelvis to head (N, 3) leads."""
    mean = (trunk / np.linalg.norm(trunk, axis=-1, keepdims=True).clip(1e-9)).mean(0)
    axis = "y" if mean[1] >= mean[2] else "z"
    if max(mean[1], mean[2]) < MOST_UPRIGHT:
        wrong = f"the head is along ({mean[0]:.2f}, {mean[1]:.2f}, {mean[2]:.2f}) from the pelvis on average"
        raise InputError(
            f"{recording.path}: {wrong}, so no up axis is found; allowed: up in the skeleton's map"
        )
    return axis
