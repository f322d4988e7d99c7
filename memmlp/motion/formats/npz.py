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
Of several names for one thing, the first in this list counts.
"""

from __future__ import annotations

import io
import math
import warnings
import zipfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_file
from memmlp.motion.body import N_JOINTS
from memmlp.motion.clip import FRAME_RATE_RANGE, Clip

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

BLOCK = 2**23  # the most bytes in a read
MAX_HEADER = 10_000  # bytes of an npy header, as in np.load
MAX_ROWS = 500_000  # frames: an hour at 120 Hz is 432,000
MAX_SCALAR = 1_024  # bytes of an array that is one number or word
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # NumPy's; others unpack without a bound


class NoMotion(InputError):
    """The file is a sound npz without motion, such as AMASS' shape.npz."""


def read_clip(path: Path, name: str) -> Clip:
    """Read a clip of the SMPL family, without ever unpickling, in bounded memory.

    Args:
        path: the file.
        name: the clip's name.

    Raises:
        NoMotion: if it is a sound npz without rotations.
        InputError: if the file is damaged, of the wrong shapes, empty, too large, or not finite; the message
            names it. Whether it can be a person's motion is checked elsewhere (`motion.plausibility`).
    """
    with _open_npz(path) as file:
        layout, trans_key, rate_key = _find_keys(file)
        parts = [file.columns(key, widths[0], widths) for key, widths in layout.items()]
        trans = file.columns(trans_key, 3, (3,))
        fps = _parse_rate(path, file.scalar(rate_key))
        lengths = {len(part) for part in (*parts, trans)}
        if len(lengths) > 1:
            keys = ", ".join((*layout, trans_key))
            raise InputError(f"{path}: {keys} have different lengths, {sorted(lengths)}")
        body = np.concatenate(parts, 1) if len(parts) > 1 else parts[0]
        bad = ~(np.isfinite(body).all(1) & np.isfinite(trans).all(1))
        if bad.any():
            raise InputError(f"{path}: NaN or Inf in {bad.sum()} frames, first in frame {bad.argmax()}")
        if np.abs(trans).max() > FARTHEST or np.abs(body).max() > FARTHEST:
            raise InputError(f"{path}: values beyond {FARTHEST:g}, so it is not in metres and radians")
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


def _find_keys(file: _Npz) -> tuple[dict[str, tuple[int, ...]], str, str]:
    if not any(key in file.names for layout in LAYOUTS for key in layout):
        raise NoMotion(f"{file.path}: no poses in it, so it is not motion")
    layout = next((layout for layout in LAYOUTS if set(layout) <= file.names), None)
    trans = next((key for key in TRANSLATIONS if key in file.names), None)
    rate = next((key for key in FRAME_RATES if key in file.names), None)
    if layout is None or trans is None or rate is None:
        keys = {"poses": layout, "trans": trans, "mocap_framerate": rate}
        missing = ", ".join(key for key, value in keys.items() if value is None)
        raise InputError(f"{file.path}: no {missing} in it, so it is not AMASS motion")
    return layout, trans, rate


def _parse_rate(path: Path, value: np.ndarray) -> float:
    """Parse the rate from a float, an int, bytes or text, as a 0-d or 1-element array."""
    if value.size != 1 or value.dtype.kind not in "fiuSU":
        raise InputError(f"{path}: the frame rate is {value.dtype} {value.shape}; expected one number")
    try:
        item = value.item()
        fps = float(item.decode() if isinstance(item, bytes) else item)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: the frame rate is not a number ({_brief(error)})") from error
    low, high = FRAME_RATE_RANGE
    if not low <= fps <= high:
        raise InputError(f"{path}: a frame rate of {fps:g} Hz; must be {low:g} to {high:g}")
    return fps


# Arrays in bounded memory, whatever the file claims. Before an array is allocated, its header must agree with
# its size in the zip's directory and with the bounds above; it is read in blocks. The exceptions of `zipfile`
# and `numpy.lib.format` for damaged bytes are not documented (among others tokenize.TokenError,
# RecursionError, struct.error), so any exception of theirs means a bad file.


@dataclass(frozen=True)
class _Header:
    """The header of an npy file; `offset` is the number of bytes before its data."""

    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype
    offset: int

    def __str__(self) -> str:
        return f"{self.dtype} {self.shape}"

    @property
    def size(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


class _Npz:
    def __init__(self, path: Path, archive: zipfile.ZipFile) -> None:
        self.path = path
        self._zip = archive
        self.names = {name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")}

    def header(self, name: str) -> _Header:
        info = self._zip.getinfo(f"{name}.npy")
        if info.compress_type not in METHODS:
            raise InputError(
                f"{self.path}: {name} has compression method {info.compress_type}; expected stored or deflate"
            )
        with self._zip.open(info) as entry:
            header = _parse_header(entry.read(MAX_HEADER))
        if min(header.shape, default=0) < 0 or header.offset + header.size != info.file_size:
            raise InputError(
                f"{self.path}: {name} is {header}, which does not fit its {info.file_size} bytes in the zip"
            )
        return header

    def scalar(self, name: str) -> np.ndarray:
        header = self.header(name)
        if header.size > MAX_SCALAR:
            raise InputError(f"{self.path}: {name} is {header}; expected one number")
        with self._zip.open(f"{name}.npy") as entry:
            entry.seek(header.offset)
            return np.frombuffer(entry.read(), header.dtype).reshape(header.shape)

    def columns(self, name: str, count: int, widths: Collection[int]) -> np.ndarray:
        """Read the first `count` columns of an array of numbers (N, >= count), or (N, J, 3), as float64.

        The array must have as many columns as `widths` allow.
        """
        header = self.header(name)
        shape = header.shape
        flat = len(shape) == 2 or (len(shape) == 3 and shape[2] == 3 and not header.fortran)
        rows, width = (shape[0], math.prod(shape[1:])) if flat else (0, 0)
        if header.dtype.kind != "f" or width not in widths:
            expected = " or ".join(f"(N, {width})" for width in widths)
            raise InputError(f"{self.path}: {name} is {header}; expected floats {expected}")
        if not 0 < rows <= MAX_ROWS:
            raise InputError(f"{self.path}: {name} is {header}; must have 1 to {MAX_ROWS} frames")
        columns = np.empty((rows, count))
        with self._zip.open(f"{name}.npy") as entry:
            entry.seek(header.offset)
            if header.fortran:
                for start, block in _read_lines(entry, header.dtype, width, rows):
                    some = block[: max(0, count - start)]
                    columns[:, start : start + len(some)] = some.T
            else:
                for start, block in _read_lines(entry, header.dtype, rows, width):
                    columns[start : start + len(block)] = block[:, :count]
        return columns


@contextmanager
def _open_npz(path: Path) -> Iterator[_Npz]:
    """Open an npz; damaged bytes raise InputError, here and while the file is read."""
    try:
        with open(path, "rb") as raw:
            magic = raw.read(2)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if magic != b"PK":
        raise InputError(f"{path}: not a zip, so not an npz (memmlp data import makes one of BVH)")
    try:
        with zipfile.ZipFile(path) as archive:
            yield _Npz(path, archive)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: not a readable npz ({_brief(error)})") from error


def _brief(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__


def _parse_header(start: bytes) -> _Header:
    """Parse an npy header from the first bytes of its file; any exception means that it is damaged."""
    stream = io.BytesIO(start)
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"an npy header of version {version}")
    with warnings.catch_warnings():  # of headers that Python 2 wrote, and of odd escapes in them
        warnings.simplefilter("ignore")
        shape, fortran, dtype = readers[version](stream, max_header_size=MAX_HEADER)
    return _Header(shape, fortran, dtype, stream.tell())


def _read_lines(
    entry: IO[bytes], dtype: np.dtype, count: int, length: int
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield `count` lines of `length` numbers in blocks (n, length), each with its first line's index."""
    step = max(1, BLOCK // (length * dtype.itemsize))
    for start in range(0, count, step):
        lines = min(step, count - start)
        data = entry.read(lines * length * dtype.itemsize)
        yield start, np.frombuffer(data, dtype).reshape(lines, length)
