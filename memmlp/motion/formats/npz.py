"""Reads and writes motion clips as npz of the SMPL family, in AMASS' layout.

The first 22 joints, which all SMPL bodies share, are read. Rotations are rotation vectors in radians;
translations are in metres, with Z up.

| body | rotations |
|---|---|
| SMPL+H (AMASS' first release) | `poses` (N, 156) |
| SMPL-X (AMASS' second release, `_stageii`) | `poses` (N, 165), or in parts (see below) |
| SMPL | `poses` (N, 72) |
| body joints only | `poses` (N, 66), or any `poses` as (N, J, 3) |
| parts with the names of human_body_prior | `root_orient` (N, 3), `pose_body` (N, 63) |
| parts with the names of the smplx package | `global_orient` (N, 3), `body_pose` (N, 63 or 69) |

The translation is `trans` or `transl` (N, 3). The frame rate is `mocap_framerate`, `mocap_frame_rate` or
`fps`. If a file has several of these arrays, the first in this list is used.
"""

import io
import math
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError, describe_read_error
from memmlp.common.files import atomic_file
from memmlp.motion.body import N_JOINTS
from memmlp.motion.clip import FRAME_RATE_RANGE, Clip

SMPLH_POSE_DIM = 156
BODY_DIM = 3 * N_JOINTS
# Arrays with rotations -> allowed numbers of columns; only the first number of columns is read.
# Other forms of rotations (matrices, quaternions, 6D) have different numbers of columns.
LAYOUTS: tuple[dict[str, tuple[int, ...]], ...] = (
    {"poses": (BODY_DIM, 72, SMPLH_POSE_DIM, 165)},
    {"root_orient": (3,), "pose_body": (BODY_DIM - 3,)},
    {"global_orient": (3,), "body_pose": (BODY_DIM - 3, 69)},
)
TRANSLATIONS = ("trans", "transl")
FRAME_RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
FARTHEST = 1e4  # metres from the origin

MAX_ROWS = 500_000  # frames: an hour at 120 Hz is 432,000
MAX_BYTES = 2**30  # maximum unpacked size of an array; 500,000 SMPL-X frames have 660 MB
METHODS = zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED  # NumPy's; others do not limit the unpacked size


class NoMotionError(InputError):
    """The file is a valid npz without motion, such as AMASS' shape.npz."""


def read_clip(path: Path, name: str) -> Clip:
    """Read a clip of an SMPL body. Pickled data is never loaded. Raises NoMotionError if the file is a valid
    npz without rotations, and InputError if it is damaged, has invalid shapes or values, or is too large.
    `motion.plausibility` checks whether the clip can be human motion."""
    with _open_npz(path) as file:
        layout, trans_key, rate_key = _find_keys(path, set(file.files))
        parts = [_read_columns(path, file, key, widths) for key, widths in layout.items()]
        trans = _read_columns(path, file, trans_key, (3,))
        fps = _parse_rate(path, _read_array(path, file, rate_key))
        lengths = {len(part) for part in (*parts, trans)}
        if len(lengths) > 1:
            keys = ", ".join((*layout, trans_key))
            raise InputError(f"{path}: {keys} must have equal lengths, not {sorted(lengths)}")
        body = np.concatenate(parts, 1) if len(parts) > 1 else parts[0]
        bad = ~(np.isfinite(body).all(1) & np.isfinite(trans).all(1))
        if bad.any():
            raise InputError(f"{path}: has NaN or Inf in {bad.sum()} frames, first in frame {bad.argmax()}")
        if np.abs(trans).max() > FARTHEST or np.abs(body).max() > FARTHEST:
            raise InputError(f"{path}: has values above {FARTHEST:g}, so it is not in metres and radians")
    return Clip(name, body.reshape(-1, N_JOINTS, 3), trans, fps)


def write_clip(path: Path, clip: Clip) -> None:
    """Write a clip in AMASS' SMPL+H layout (hands at rest, zero betas, neutral gender), atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    poses = np.zeros((len(clip), SMPLH_POSE_DIM), np.float32)
    poses[:, :BODY_DIM] = clip.poses.reshape(len(clip), -1)
    with atomic_file(path) as file:
        np.savez(
            file,
            poses=poses,
            trans=clip.trans.astype(np.float32),
            betas=np.zeros(16, np.float32),
            gender=np.array("neutral"),
            mocap_framerate=np.array(float(clip.fps)),
        )


def _find_keys(path: Path, names: set[str]) -> tuple[dict[str, tuple[int, ...]], str, str]:
    if not any(key in names for layout in LAYOUTS for key in layout):
        raise NoMotionError(f"{path}: has no poses, so it is not motion")
    layout = next((layout for layout in LAYOUTS if set(layout) <= names), None)
    trans = next((key for key in TRANSLATIONS if key in names), None)
    rate = next((key for key in FRAME_RATES if key in names), None)
    if layout is None or trans is None or rate is None:
        keys = {"poses": layout, "trans": trans, "mocap_framerate": rate}
        missing = ", ".join(key for key, value in keys.items() if value is None)
        raise InputError(f"{path}: has no {missing}, so it is not AMASS motion")
    return layout, trans, rate


def _parse_rate(path: Path, value: np.ndarray) -> float:
    """Parse the rate from an array with one float, int, bytes or text element."""
    if value.size != 1 or value.dtype.kind not in "fiuSU":
        found = f"{path}: the frame rate has type {value.dtype}, shape {value.shape}"
        raise InputError(f"{found}; must be a number")
    try:
        item = value.item()
        fps = float(item.decode() if isinstance(item, bytes) else item)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: the frame rate is not a number ({str(error)[:120]})") from error
    low, high = FRAME_RATE_RANGE
    if not low <= fps <= high:
        raise InputError(f"{path}: the frame rate is {fps:g} Hz; must be from {low:g} to {high:g} Hz")
    return fps


def _read_array(path: Path, file: np.lib.npyio.NpzFile, key: str) -> np.ndarray:
    """Read an array, after a check of its unpacked size."""
    assert file.zip is not None  # it is open
    info = file.zip.getinfo(f"{key}.npy")
    if info.compress_type not in METHODS:
        found = f"{path}: {key} has compression method {info.compress_type}"
        raise InputError(f"{found}; must be stored or deflate")
    if info.file_size > MAX_BYTES:
        raise InputError(f"{path}: {key} has {info.file_size} bytes; must have at most {MAX_BYTES}")
    stream = io.BytesIO(file.zip.read(info))  # all bytes, so that their checksum is checked
    array = np.lib.format.read_array(stream, allow_pickle=False)
    if stream.read(1):
        raise InputError(f"{path}: {key} has more bytes than an array {array.dtype} {array.shape}")
    return array


def _read_columns(path: Path, file: np.lib.npyio.NpzFile, key: str, widths: Sequence[int]) -> np.ndarray:
    """Read the first `widths[0]` columns of an array (N, columns) or (N, J, 3) as float64. The number of
    columns must be in `widths`."""
    array = _read_array(path, file, key)
    found = f"{path}: {key} has type and shape {array.dtype} {array.shape}"
    is_flat = array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)
    if array.dtype.kind != "f" or not is_flat or math.prod(array.shape[1:]) not in widths:
        raise InputError(f"{found}; must be floats {' or '.join(f'(N, {width})' for width in widths)}")
    if not 0 < len(array) <= MAX_ROWS:
        raise InputError(f"{found}; must have 1 to {MAX_ROWS} frames")
    return np.ascontiguousarray(array.reshape(len(array), -1)[:, : widths[0]], np.float64)


@contextmanager
def _open_npz(path: Path) -> Iterator[np.lib.npyio.NpzFile]:
    """Open an npz file. Damaged bytes raise InputError within the whole context: for these, `zipfile` and
    NumPy raise undocumented exceptions, such as tokenize.TokenError or struct.error."""
    try:
        with open(path, "rb") as raw, warnings.catch_warnings():
            if raw.read(2) != b"PK":
                expected = "convert BVH files with memmlp data import"
                raise InputError(f"{path}: not a zip, so not an npz file; {expected}")
            raw.seek(0)
            warnings.simplefilter("ignore")  # about headers written by Python 2, and about unusual escapes
            with np.load(raw, allow_pickle=False) as file:
                yield file
    except InputError:
        raise
    except Exception as error:
        reason = describe_read_error(error)[:120] or type(error).__name__
        raise InputError(f"{path}: cannot be read as npz ({reason})") from error
