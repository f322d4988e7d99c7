"""Motion clips in memory, and their resampling to 60 Hz."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, RotationSpline, Slerp

from memmlp.common.errors import InputError
from memmlp.motion.body import FPS, N_JOINTS

FRAME_RATE_RANGE = (1.0, 1000.0)
INTERPOLATED = "interpolated"
PIECE = 3600  # frames of a long clip that are worked on at a time
SPLINES, LINES = "splines", "lines"
INTERPOLATIONS = (SPLINES, LINES)
"""How motion is interpolated at times that lie between two recorded frames.

Splines are smooth, as motion is. Lines have a kink at each recorded frame, and so a jerk that no body has:
four times as much as there is in Bandai-Namco's motion at 30 Hz (docs/guides/motion.md).
"""
RATE_TOLERANCE = 1e-4  # relative: 59.94 is not 60, and 120.0005 (a BVH's frame time of .0083333) is 120


@dataclass(frozen=True)
class Skipped:
    """A file that was skipped.

    Attributes:
        file: the file's path below the folder.
        reason: why it was skipped, in one line.
    """

    file: str
    reason: str


@dataclass(frozen=True)
class Clip:
    """Motion of the 22 body joints.

    Attributes:
        name: path below the data root, `/`-separated, without suffix.
        poses: axis-angle (N, 22, 3), radians: local rotations, the root's global.
        trans: translation (N, 3), metres, world (Z up); the root joint is at rest[0] + trans.
        fps: frames per second.
    """

    name: str
    poses: np.ndarray
    trans: np.ndarray
    fps: float

    def __len__(self) -> int:
        return len(self.poses)

    def pieces(self, frames: int = PIECE) -> Iterator[Clip]:
        """Yield the clip in successive pieces of at most `frames` frames."""
        for start in range(0, len(self), frames):
            piece = slice(start, start + frames)
            yield replace(self, poses=self.poses[piece], trans=self.trans[piece])


def resample(clip: Clip, fps: float = FPS, interpolation: str = SPLINES) -> tuple[Clip, str]:
    """Resample a clip to exactly `fps`, and say how: `kept`, `every k. frame`, or `interpolated`.

    If the clip's rate is a multiple of `fps`, every k-th frame is taken; otherwise poses and translation are
    interpolated at the times k / fps that lie inside the clip.

    Args:
        clip: the clip.
        fps: the wanted rate, Hz.
        interpolation: SPLINES, with continuous accelerations of joints' rotations and of the translation, or
            LINES, slerp and straight lines.

    Raises:
        InputError: if a clip of one frame would have to be interpolated.
    """
    ratio = clip.fps / fps
    stride = round(ratio)
    if stride >= 1 and abs(ratio - stride) <= RATE_TOLERANCE * stride:
        how = "kept" if stride == 1 else f"every {stride}. frame"
        return replace(clip, poses=clip.poses[::stride], trans=clip.trans[::stride], fps=float(fps)), how
    if len(clip) < 2:
        raise InputError(f"{clip.name}: one frame at {clip.fps:g} Hz cannot be brought to {fps:g} Hz")
    times = np.arange(len(clip)) / clip.fps
    wanted = np.arange(int(np.floor(times[-1] * fps + 1e-9)) + 1) / fps
    wanted = np.minimum(wanted, times[-1])
    turning, move = (RotationSpline, _spline) if interpolation == SPLINES else (Slerp, _lines)
    joints = [turning(times, Rotation.from_rotvec(clip.poses[:, j])) for j in range(N_JOINTS)]
    poses = np.stack([joint(wanted).as_rotvec() for joint in joints], 1)
    return replace(clip, poses=poses, trans=move(times, clip.trans, wanted), fps=float(fps)), INTERPOLATED


def _spline(times: np.ndarray, points: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return where a cubic spline through points (N, 3) at times (N,) is at the wanted times (M,): (M, 3)."""
    from scipy.interpolate import CubicSpline  # slow to import, and most clips need none

    return CubicSpline(times, points)(wanted)


def _lines(times: np.ndarray, points: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return where lines through points (N, 3) at times (N,) are at the wanted times (M,): (M, 3)."""
    return np.stack([np.interp(wanted, times, axis) for axis in points.T], 1)
