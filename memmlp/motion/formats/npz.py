"""Reads and writes motion clips as AMASS npz."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.body import N_JOINTS
from memmlp.motion.clip import FRAME_RATE_RANGE, Clip

SMPLH_POSE_DIM = 156
FRAME_RATE_KEYS = ("mocap_framerate", "mocap_frame_rate")  # SMPL+H and SMPL-X releases
# The exceptions that NumPy and zipfile raise on damaged bytes.
DAMAGE = (
    OSError, ValueError, EOFError, KeyError, AttributeError, TypeError, IndexError, MemoryError,
    NotImplementedError, SyntaxError, RuntimeError, OverflowError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


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
