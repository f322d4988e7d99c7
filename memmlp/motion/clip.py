"""Motion clips in memory: resampling to 60 Hz, usual frame rates, and conversion to Y-up worlds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.body import FPS, N_JOINTS

FRAME_RATE_RANGE = (1.0, 1000.0)
INTERPOLATED = "interpolated"
PIECE = 3600  # maximum number of frames that are processed at a time
SPLINES, LINES = "splines", "lines"
"""The methods of interpolation between two recorded frames. Splines are as smooth as human motion. Lines have
a kink at each recorded frame. For Bandai-Namco's motion at 30 Hz, that makes the jerk four times as large
(docs/guides/checks.md)."""
RATE_TOLERANCE = 1e-4  # relative: 59.94 is not 60, and 120.0005 (a BVH's frame time of .0083333) is 120


@dataclass(frozen=True)
class SkippedFile:
    """A skipped file, as its path below the folder, and the reason in one line."""

    file: str
    reason: str


def describe_first(skipped: Sequence[SkippedFile]) -> str:
    """Return the first of several skipped files as the end of a message; empty without one."""
    return f"; the first: {skipped[0].file}: {skipped[0].reason}" if skipped else ""


@dataclass(frozen=True)
class Clip:
    """Motion of the 22 body joints."""

    name: str  # path below the data root, `/`-separated, without suffix
    poses: np.ndarray  # axis-angle (N, 22, 3), radians: local rotations; the root's rotation is global
    trans: np.ndarray  # translation (N, 3), metres, world (Z up); the root joint is at rest[0] + trans
    fps: float  # frames per second

    def __len__(self) -> int:
        return len(self.poses)

    def split_into_pieces(self, frames: int = PIECE) -> Iterator[Clip]:
        """Yield the clip in successive pieces of at most `frames` frames."""
        for start in range(0, len(self), frames):
            piece = slice(start, start + frames)
            yield replace(self, poses=self.poses[piece], trans=self.trans[piece])


def resample(clip: Clip, fps: float = FPS, interpolation: str = SPLINES) -> tuple[Clip, str]:
    """Resample a clip to exactly `fps`, and return the method: `kept`, `every k. frame`, or `interpolated`.
    If the clip's rate is a multiple of `fps`, every k-th frame is kept. Otherwise poses and translation are
    interpolated at the times k / fps within the clip: by SPLINES, which give continuous accelerations, or by
    LINES, slerp for rotations and linear for the translation. Raises InputError if the clip needs
    interpolation but has only one frame."""
    ratio = clip.fps / fps
    stride = round(ratio)
    if stride >= 1 and abs(ratio - stride) <= RATE_TOLERANCE * stride:
        method = "kept" if stride == 1 else f"every {stride}. frame"
        return replace(clip, poses=clip.poses[::stride], trans=clip.trans[::stride], fps=float(fps)), method
    if len(clip) < 2:
        raise InputError(f"{clip.name}: one frame at {clip.fps:g} Hz cannot be resampled to {fps:g} Hz")
    from scipy.spatial.transform import Rotation, RotationSpline, Slerp  # 0.4 s to import

    times = np.arange(len(clip)) / clip.fps
    new = np.arange(int(np.floor(times[-1] * fps + 1e-9)) + 1) / fps
    new = np.minimum(new, times[-1])
    turning = RotationSpline if interpolation == SPLINES else Slerp
    joints = [turning(times, Rotation.from_rotvec(clip.poses[:, j])) for j in range(N_JOINTS)]
    poses = np.stack([joint(new).as_rotvec() for joint in joints], 1)
    if interpolation == SPLINES:
        from scipy.interpolate import CubicSpline  # slow to import, and most clips do not need it

        trans = CubicSpline(times, clip.trans)(new)
    else:
        trans = np.stack([np.interp(new, times, axis) for axis in clip.trans.T], 1)
    return replace(clip, poses=poses, trans=trans, fps=float(fps)), INTERPOLATED


USUAL_RATES = (15, 24, 25, 30, 48, 50, 60, 72, 75, 90, 100, 120, 144, 150, 180, 200, 240, 300)  # Hz
RARE_RATES = (20, 40, 80, 250, 360, 400, 480, 500)  # Hz; a rounded frame time is not taken for these
CLOSE = 2e-3  # relative: 29.97, 59.94 and 119.88 Hz are rates of video


def find_nearest_rate(rate: float) -> float:
    """Return the usual or rare rate with the smallest ratio to a rate, Hz."""
    return float(min(USUAL_RATES + RARE_RATES, key=lambda usual: max(usual / rate, rate / usual)))


def is_known_rate(rate: float) -> bool:
    """Return whether a rate, Hz, is a usual rate of motion data. Other rates may be mistakes."""
    return abs(find_nearest_rate(rate) - rate) <= CLOSE * rate


Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # from AMASS' world: (x, y, z) becomes (x, z, -y)


def convert_to_y_up(clip: Clip, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert a clip to a right-handed world with Y up: local rotations (N, 22, 3, 3), of which the root's is
    global, and the root's positions (N, 3), metres. If all rotations are the identity, the person stands
    upright in T-pose and faces +Z. The rest joints need no conversion, because SMPL's body frame has the same
    axes."""
    from scipy.spatial.transform import Rotation  # 0.4 s to import

    rotations = Rotation.from_rotvec(clip.poses.reshape(-1, 3)).as_matrix().reshape(-1, N_JOINTS, 3, 3)
    rotations[:, 0] = Y_UP @ rotations[:, 0]
    return rotations, (rest[0] + clip.trans) @ Y_UP.T
