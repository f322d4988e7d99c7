"""Reads and writes motion clips as npz of the SMPL family, in AMASS' layout.

The first 22 joints, which all of the family's bodies share, are read as rotation vectors in radians, Z up,
metres:

| body | rotations |
|---|---|
| SMPL+H (AMASS' first release) | `poses` (N, 156) |
| SMPL-X (AMASS' second, `_stageii`) | `poses` (N, 165), and in parts as below |
| SMPL | `poses` (N, 72) |
| the body's joints alone | `poses` (N, 66), or any of the above as (N, J, 3) |
| parts as human_body_prior names them | `root_orient` (N, 3), `pose_body` (N, 63) |
| parts as the smplx package names them | `global_orient` (N, 3), `body_pose` (N, 63 or 69) |

The translation is `trans` or `transl` (N, 3); the frame rate `mocap_framerate`, `mocap_frame_rate` or `fps`.
A file that has something under several of these names, as SMPL-X' have the rotations, must have it alike.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_file
from memmlp.motion.body import N_JOINTS
from memmlp.motion.clip import FRAME_RATE_RANGE, Clip
from memmlp.motion.formats.bounded_npz import Npz, brief, open_npz

SMPLH_POSE_DIM = 156
BODY_DIM = 3 * N_JOINTS
# Arrays that hold the rotations, side by side, and how many columns each may have; the first number is read.
# Rotations in another form (matrices, quaternions, 6D) have other numbers of columns.
LAYOUTS: tuple[dict[str, tuple[int, ...]], ...] = (
    {"poses": (BODY_DIM, 72, SMPLH_POSE_DIM, 165)},
    {"root_orient": (3,), "pose_body": (BODY_DIM - 3,)},
    {"global_orient": (3,), "body_pose": (BODY_DIM - 3, 69)},
)
TRANSLATIONS = ("trans", "transl")
FRAME_RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
FARTHEST = 1e4  # metres from the origin
SAME = 0.01  # radians or metres by which two arrays of one motion differ at most, whatever their precisions


class NoMotion(InputError):
    """The file is a sound npz of something other than motion, such as AMASS' shape.npz."""


def read_clip(path: Path, name: str) -> Clip:
    """Read a clip of the SMPL family, without ever unpickling, in bounded memory (`formats.bounded_npz`).

    Args:
        path: the file.
        name: the clip's name.

    Raises:
        NoMotion: if it is a sound npz without rotations.
        InputError: if the file is damaged, of the wrong shapes, empty, too large, or not finite; the message
            names it. Whether it can be a person's motion is checked elsewhere (`motion.plausibility`).
    """
    with open_npz(path) as file:
        layout, trans_key, rate_key = _keys(file)
        parts = [file.columns(key, widths[0], widths) for key, widths in layout.items()]
        trans = file.columns(trans_key, 3, (3,))
        fps = _frame_rate(path, file.scalar(rate_key))
        _check_rates(file, fps)
        keys = (*layout, trans_key)
        lengths = {len(part) for part in (*parts, trans)}
        if len(lengths) > 1:
            raise InputError(f"{path}: {', '.join(keys)} have different lengths, {sorted(lengths)}")
        body = np.concatenate(parts, 1) if len(parts) > 1 else parts[0]
        _check_numbers(path, body, trans)
        _check_copies(file, keys, body, trans)
    return Clip(name, body.reshape(-1, N_JOINTS, 3), trans, fps)


def _keys(file: Npz) -> tuple[dict[str, tuple[int, ...]], str, str]:
    """Return the layout of a file, and its keys of translation and frame rate."""
    if not any(key in file.names for layout in LAYOUTS for key in layout):
        raise NoMotion(f"{file.path}: no poses in it, so it is no motion")
    layout = next((layout for layout in LAYOUTS if set(layout) <= file.names), None)
    trans = next((key for key in TRANSLATIONS if key in file.names), None)
    rate = next((key for key in FRAME_RATES if key in file.names), None)
    if layout is None or trans is None or rate is None:
        found = {"poses": layout, "trans": trans, "mocap_framerate": rate}
        missing = ", ".join(key for key, value in found.items() if value is None)
        raise InputError(f"{file.path}: no {missing} in it, so it is no AMASS motion")
    return layout, trans, rate


def _check_rates(file: Npz, fps: float) -> None:
    """Raise InputError if the file has a frame rate under another name, too, and it is another one."""
    for key in FRAME_RATES:
        if key in file.names and (other := _frame_rate(file.path, file.scalar(key))) != fps:
            raise InputError(f"{file.path}: has two frame rates, {fps:g} and {key}={other:g}; allowed is one")


def _check_copies(file: Npz, read: Sequence[str], body: np.ndarray, trans: np.ndarray) -> None:
    """Raise InputError if the file has rotations or a translation under other names, too, and other ones.

    One of them may have been turned, moved or filtered, and the other forgotten.

    Args:
        file: the file.
        read: the names under which its motion was read.
        body: the rotations (N, 66) that were read.
        trans: the translation (N, 3) that was read.
    """
    widths = {key: widths for layout in LAYOUTS for key, widths in layout.items()}
    roots, bodies = ("root_orient", "global_orient"), ("pose_body", "body_pose")
    same = {**dict.fromkeys(roots, body[:, :3]), **dict.fromkeys(bodies, body[:, 3:])}
    same |= dict.fromkeys(TRANSLATIONS, trans)
    for key in sorted((same.keys() & file.names) - set(read)):
        copy = file.columns(key, same[key].shape[1], widths.get(key, (3,)))
        if copy.shape != same[key].shape or not (np.abs(copy - same[key]) <= SAME).all():
            raise InputError(f"{file.path}: {key} is another motion than {', '.join(read)}; allowed is one")


def _check_numbers(path: Path, body: np.ndarray, trans: np.ndarray) -> None:
    """Raise InputError for numbers that are not finite, or beyond all plausible bounds."""
    bad = ~(np.isfinite(body).all(1) & np.isfinite(trans).all(1))
    if bad.any():
        raise InputError(f"{path}: NaN or Inf in {bad.sum()} frames, first in frame {bad.argmax()}")
    if np.abs(trans).max() > FARTHEST or np.abs(body).max() > FARTHEST:
        raise InputError(f"{path}: values beyond {FARTHEST:g}, so it is not in metres and radians")


def write_clip(path: Path, clip: Clip) -> None:
    """Write a clip in AMASS' SMPL+H layout (hands at rest, zero betas, neutral gender), atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    about = {"descr": "<f4", "fortran_order": False, "shape": (len(clip), SMPLH_POSE_DIM)}
    others = {
        "trans": clip.trans.astype(np.float32),
        "betas": np.zeros(16, np.float32),
        "gender": np.array("neutral"),
        "mocap_framerate": np.array(float(clip.fps)),
    }
    with atomic_file(path) as file, zipfile.ZipFile(file, "w") as archive:
        with archive.open("poses.npy", "w", force_zip64=True) as member:  # in pieces: it may be an hour
            np.lib.format.write_array_header_1_0(member, about)
            member.writelines(_smplh(piece).tobytes() for piece in clip.pieces())
        for name, array in others.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def _smplh(clip: Clip) -> np.ndarray:
    """Return a clip's poses (N, 156) with hands at rest, float32."""
    poses = np.zeros((len(clip), SMPLH_POSE_DIM), "<f4")
    poses[:, :BODY_DIM] = clip.poses.reshape(len(clip), -1)
    return poses


def _frame_rate(path: Path, value: np.ndarray) -> float:
    """Parse the rate from a float, an int, bytes or text, as a 0-d or 1-element array."""
    if value.size != 1 or value.dtype.kind not in "fiuSU":
        raise InputError(f"{path}: the frame rate is {value.dtype} {value.shape}, not one number")
    try:
        item = value.item()
        fps = float(item.decode() if isinstance(item, bytes) else item)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: the frame rate is no number ({brief(error)})") from error
    low, high = FRAME_RATE_RANGE
    if not low <= fps <= high:
        raise InputError(f"{path}: a frame rate of {fps:g} Hz; allowed: {low:g} to {high:g}")
    return fps
