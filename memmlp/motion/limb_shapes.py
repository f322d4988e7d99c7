"""The round limbs that show a body in pictures, on the live page, and in glTF files."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from memmlp.motion.body import HEAD, JOINTS, LEFT_WRIST, PARENTS, RIGHT_WRIST

_RADII = {
    "pelvis": 0.100, "hip": 0.082, "knee": 0.054, "ankle": 0.038, "foot": 0.030, "spine1": 0.100,
    "spine2": 0.106, "spine3": 0.108, "neck": 0.050, "collar": 0.062, "head": 0.052, "shoulder": 0.054,
    "elbow": 0.041, "wrist": 0.031,
}  # fmt: skip
RADII = tuple(_RADII[name.split("_")[-1]] for name in JOINTS)
"""The body's radius at each joint, metres."""

HEAT = ("#2b5fd9", "#27a9e1", "#3fc380", "#f2d43d", "#f28c28", "#c4161c")
"""The colour scale for joint errors, from zero to the maximum, evenly spaced."""


class Limb(NamedTuple):
    """A round limb from one joint to another, or from a joint to a tip.

    Attributes:
        start, end: the joints that determine the colours of its two ends.
        radii: the radii at its two ends, metres.
        tip: 0 for a limb between the two joints. Otherwise the limb begins at `end`, and extends by this
            length, metres, in the direction from `start` to `end`.
    """

    start: int
    end: int
    radii: tuple[float, float]
    tip: float = 0.0

    @property
    def first_joint(self) -> int:
        """The joint where the limb begins."""
        return self.end if self.tip else self.start


LIMBS = (
    *(Limb(p, j, (RADII[p], RADII[j])) for j, p in enumerate(PARENTS) if p >= 0),
    Limb(PARENTS[HEAD], HEAD, (0.085, 0.095), 0.085),
    *(Limb(PARENTS[hand], hand, (0.031, 0.038), 0.085) for hand in (LEFT_WRIST, RIGHT_WRIST)),
)


def find_limb_ends(limb: Limb, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of a limb's two ends, each (3,), metres, for the joint positions (22, 3)."""
    start, end = joints[limb.start], joints[limb.end]
    if not limb.tip:
        return start, end
    along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)
    return end, end + limb.tip * along
