"""Whether a recording begins with a calibration pose, such as a T-pose, which is no motion."""

from __future__ import annotations

import numpy as np

from memmlp.motion.importing.motion_file import MotionFile

MAYBE, JUMP = 1.5, 4.0  # first steps from which on frame 0 may be, and is, a calibration pose
JUMPED = 0.05  # a smaller step, in multiples of the skeleton's size, is none


def first_step(recording: MotionFile) -> float:
    """Return the step from frame 0 to frame 1, divided by the 90 % quantile of all later steps.

    A step is the largest distance by which a node moves relative to the root. The result is 0 for a short
    recording, or if the first step is small compared with the body.
    """
    if len(recording) < 4:
        return 0.0
    positions = recording.kinematics()[1]
    pose = positions - positions[:, :1]
    steps = np.linalg.norm(np.diff(pose, axis=0), axis=-1).max(-1)
    if steps[0] <= JUMPED * np.linalg.norm(pose[0], axis=-1).max():
        return 0.0
    return float(steps[0] / max(np.quantile(steps[1:], 0.9), 1e-9))
