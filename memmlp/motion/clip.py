"""Motion clips on disk (AMASS npz) and in memory, and their exact resampling to 60 Hz."""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from memmlp.common.errors import InputError
from memmlp.motion.body import FPS, N_JOINTS

SMPLH_POSE_DIM = 156
FRAME_RATE_KEYS = ("mocap_framerate", "mocap_frame_rate")  # SMPL+H and SMPL-X releases
FRAME_RATE_RANGE = (1.0, 1000.0)
# The exceptions that NumPy and zipfile raise on damaged bytes.
DAMAGE = (
    OSError, ValueError, EOFError, KeyError, AttributeError, TypeError, IndexError, MemoryError,
    NotImplementedError, SyntaxError, RuntimeError, OverflowError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
RATE_TOLERANCE = 1e-4  # relative: 59.94 is not 60, and 120.0005 (a BVH's frame time of .0083333) is 120


@dataclass(frozen=True)
class Skipped:
    """A file that was skipped.

    Attributes:
        file: its path below the folder.
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


def read_clip(path: Path, name: str) -> Clip:
    """Read an SMPL+H or SMPL-X AMASS npz, without ever unpickling.

    Args:
        path: the file.
        name: the clip's name.

    Raises:
        InputError: if the file is damaged, of the wrong shapes, empty, or not finite; the message names it.
    """
    try:
        # The file is opened here, since np.load does not close one that is no zip.
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            missing = {"poses", "trans"} - set(file.files)
            rate_key = next((key for key in FRAME_RATE_KEYS if key in file.files), None)
            if missing or rate_key is None:
                keys = ", ".join(sorted(missing) or [FRAME_RATE_KEYS[0]])
                raise InputError(f"{path}: no {keys} in it, so it is no AMASS motion")
            poses, trans, rate = file["poses"], file["trans"], file[rate_key]
    except InputError:
        raise
    except DAMAGE as error:
        raise InputError(f"{path}: not a readable npz ({_brief(error)})") from error
    fps = _frame_rate(path, rate)
    if poses.ndim != 2 or poses.shape[1] < 3 * N_JOINTS or not np.issubdtype(poses.dtype, np.floating):
        raise InputError(f"{path}: poses is {poses.dtype} {poses.shape}, not floats (N, >= {3 * N_JOINTS})")
    if trans.shape != (len(poses), 3) or not np.issubdtype(trans.dtype, np.floating):
        raise InputError(f"{path}: trans is {trans.dtype} {trans.shape}, not floats ({len(poses)}, 3)")
    if len(poses) == 0:
        raise InputError(f"{path}: no frames")
    body = poses[:, : 3 * N_JOINTS].astype(np.float64)
    trans = trans.astype(np.float64)
    bad = ~(np.isfinite(body).all(1) & np.isfinite(trans).all(1))
    if bad.any():
        raise InputError(f"{path}: NaN or Inf in {bad.sum()} frames, first in frame {bad.argmax()}")
    if np.abs(trans).max() > 1e4 or np.abs(body).max() > 1e4:
        raise InputError(f"{path}: values beyond 1e4, so it is not in metres and radians")
    return Clip(name, body.reshape(-1, N_JOINTS, 3), trans, fps)


def write_clip(path: Path, clip: Clip) -> None:
    """Write a clip in AMASS' SMPL+H layout (hands at rest, zero betas, neutral gender), atomically."""
    poses = np.zeros((len(clip), SMPLH_POSE_DIM), np.float32)
    poses[:, : 3 * N_JOINTS] = clip.poses.reshape(len(clip), -1)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".tmp")
    with open(temporary, "wb") as file:
        np.savez(
            file,
            poses=poses,
            trans=clip.trans.astype(np.float32),
            betas=np.zeros(16, np.float32),
            gender=np.array("neutral"),
            mocap_framerate=np.array(float(clip.fps)),
        )
    temporary.replace(path)


def resample(clip: Clip, fps: float = FPS) -> tuple[Clip, str]:
    """Resample a clip to exactly `fps`, and say how: `kept`, `every k. frame`, or `interpolated`.

    Where the rate divides, frames are taken by stride; otherwise rotations are interpolated by slerp and the
    translation linearly, at the times k / fps that lie inside the clip.

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
    poses = np.stack(
        [Slerp(times, Rotation.from_rotvec(clip.poses[:, j]))(wanted).as_rotvec() for j in range(N_JOINTS)], 1
    )
    trans = np.stack([np.interp(wanted, times, clip.trans[:, axis]) for axis in range(3)], 1)
    return replace(clip, poses=poses, trans=trans, fps=float(fps)), "interpolated"


def _frame_rate(path: Path, value: np.ndarray) -> float:
    """Parse the rate from a float, an int, bytes or text, as a 0-d or 1-element array."""
    if value.size != 1 or value.dtype.kind not in "fiuSU":
        raise InputError(f"{path}: the frame rate is {value.dtype} {value.shape}, not one number")
    try:
        item = value.item()
        fps = float(item.decode() if isinstance(item, bytes) else item)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: the frame rate is no number ({_brief(error)})") from error
    low, high = FRAME_RATE_RANGE
    if not low <= fps <= high:
        raise InputError(f"{path}: a frame rate of {fps:g} Hz; allowed: {low:g} to {high:g}")
    return fps


def _brief(error: Exception) -> str:
    """Shorten an exception's message to one line."""
    return " ".join(str(error).split())[:120] or type(error).__name__
