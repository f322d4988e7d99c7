"""Converts a recording on its own skeleton to a clip on the body: axes, stance, rotations, floor, check."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from memmlp.motion.clip import Clip
from memmlp.motion.clip_kinematics import clip_kinematics
from memmlp.motion.importing.axes import with_unit_and_up
from memmlp.motion.importing.fidelity import Fidelity, compare
from memmlp.motion.importing.floor import find_floor
from memmlp.motion.importing.mapped_motion import MappedMotion, pick_joints
from memmlp.motion.importing.motion_file import MotionFile
from memmlp.motion.importing.retarget import fit, to_body
from memmlp.motion.importing.skeleton_map import SkeletonMap

AUTO, NONE = "auto", "none"  # what a floor may be beside a height


@dataclass(frozen=True)
class Converted:
    """A recording converted to the body.

    Attributes:
        clip: the motion, world (Z up), with its floor at 0 if the floor is known.
        mapped_motion: the mapped joints' motion from which the clip was made.
        fidelity: how far the clip is from that motion, and what is wrong with it.
        floor: height of the floor in the recording, metres on the body's scale, which was subtracted; None if
            it is unknown or was not asked for.
        scale: the body's size, as a multiple of the recording's.
        stance_words: the stance from which the skeleton was read, in words.
        unit: the file's unit, metres, given or found.
        up: the file's up axis, given or found.
    """

    clip: Clip
    mapped_motion: MappedMotion
    fidelity: Fidelity
    floor: float | None
    scale: float
    stance_words: str
    unit: float
    up: str


def convert(
    recording: MotionFile,
    skeleton: SkeletonMap,
    rest: np.ndarray,
    *,
    name: str,
    fps: float | None = None,
    floor: str | float = AUTO,
) -> Converted:
    """Convert a recording to a body.

    Args:
        recording: the file's motion.
        skeleton: the recording's skeleton map.
        rest: the body's rest joints (22, 3), metres.
        name: the clip's name.
        fps: the true frame rate, Hz; by default the file's.
        floor: `auto`, found from the feet; `none`, left as it is; or the floor's height in the file, metres.

    Raises:
        InputError: as `mapped_motion.pick_joints` and `retarget.fit` do.
    """
    settled = with_unit_and_up(recording, skeleton)
    mapped_motion = pick_joints(recording, settled)
    fitted = fit(recording, settled, mapped_motion, rest)
    clip = to_body(mapped_motion, fitted, rest, name, fps or recording.fps)
    if floor == AUTO:
        height = find_floor(clip_kinematics(clip, rest)[1], clip.fps)
    else:
        height = None if floor == NONE else float(floor) * fitted.scale
    clip = lowered(clip, height or 0.0)
    return Converted(
        clip=clip,
        mapped_motion=mapped_motion,
        fidelity=compare(clip, mapped_motion, rest, skeleton.name),
        floor=height,
        scale=fitted.scale,
        stance_words=fitted.stance_words,
        unit=float(settled.unit or 1.0),
        up=str(settled.up),
    )


def lowered(clip: Clip, height: float) -> Clip:
    """Return a clip moved down by a height, metres."""
    return replace(clip, trans=clip.trans - [0.0, 0.0, height])
