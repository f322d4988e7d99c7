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

BLOCK = 2**23  # maximum number of bytes per read
MAX_HEADER = 10_000  # bytes of an npy header, as in np.load
MAX_ROWS = 500_000  # frames: an hour at 120 Hz is 432,000
MAX_SCALAR = 1_024  # maximum size of a scalar array, bytes
METHODS = zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED  # NumPy's; others do not limit the unpacked size


class NoMotionError(InputError):
    """The file is a valid npz without motion, such as AMASS' shape.npz."""


def read_clip(path: Path, name: str) -> Clip:
    """Read a clip of an SMPL body in bounded memory. Pickled data is never loaded. Raises NoMotionError if
    the file is a valid npz without rotations, and InputError if it is damaged, has invalid shapes or values,
    or is too large. `motion.plausibility` checks whether the clip can be human motion."""
    with _open_npz(path) as file:
        layout, trans_key, rate_key = _find_keys(file)
        parts = [file.read_columns(key, widths[0], widths) for key, widths in layout.items()]
        trans = file.read_columns(trans_key, 3, (3,))
        fps = _parse_rate(path, file.read_scalar(rate_key))
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


def _find_keys(file: _NpzReader) -> tuple[dict[str, tuple[int, ...]], str, str]:
    if not any(key in file.names for layout in LAYOUTS for key in layout):
        raise NoMotionError(f"{file.path}: has no poses, so it is not motion")
    layout = next((layout for layout in LAYOUTS if set(layout) <= file.names), None)
    trans = next((key for key in TRANSLATIONS if key in file.names), None)
    rate = next((key for key in FRAME_RATES if key in file.names), None)
    if layout is None or trans is None or rate is None:
        keys = {"poses": layout, "trans": trans, "mocap_framerate": rate}
        missing = ", ".join(key for key, value in keys.items() if value is None)
        raise InputError(f"{file.path}: has no {missing}, so it is not AMASS motion")
    return layout, trans, rate


def _parse_rate(path: Path, value: np.ndarray) -> float:
    """Parse the rate from an array with one float, int, bytes or text element."""
    if value.size != 1 or value.dtype.kind not in "fiuSU":
        raise InputError(
            f"{path}: the frame rate has type {value.dtype}, shape {value.shape}; must be a number"
        )
    try:
        item = value.item()
        fps = float(item.decode() if isinstance(item, bytes) else item)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: the frame rate is not a number ({_shorten_error(error)})") from error
    low, high = FRAME_RATE_RANGE
    if not low <= fps <= high:
        raise InputError(f"{path}: the frame rate is {fps:g} Hz; must be from {low:g} to {high:g} Hz")
    return fps


# Arrays are read in bounded memory. Before an array is allocated, its header is compared with its size in
# the zip's directory and with the limits above. Then the array is read in blocks. For damaged bytes,
# `zipfile` and `numpy.lib.format` raise undocumented exceptions, such as tokenize.TokenError or struct.error.
# So any exception from these modules means a bad file.


@dataclass(frozen=True)
class _Header:
    """The header of an npy file; `offset` is the number of bytes before the data."""

    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype
    offset: int

    def __str__(self) -> str:
        return f"{self.dtype} {self.shape}"

    @property
    def size(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


class _NpzReader:
    def __init__(self, path: Path, archive: zipfile.ZipFile) -> None:
        self.path = path
        self._zip = archive
        self.names = {name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")}

    def read_header(self, name: str) -> _Header:
        info = self._zip.getinfo(f"{name}.npy")
        if info.compress_type not in METHODS:
            raise InputError(
                f"{self.path}: {name} has compression method {info.compress_type}; must be stored or deflate"
            )
        with self._zip.open(info) as entry:
            header = _parse_header(entry.read(MAX_HEADER))
        if min(header.shape, default=0) < 0 or header.offset + header.size != info.file_size:
            raise InputError(f"{self.path}: {name} has type and shape {header}, but {info.file_size} bytes")
        return header

    def read_scalar(self, name: str) -> np.ndarray:
        header = self.read_header(name)
        if header.size > MAX_SCALAR:
            raise InputError(f"{self.path}: {name} has type and shape {header}; must be one number")
        with self._zip.open(f"{name}.npy") as entry:
            entry.seek(header.offset)
            return np.frombuffer(entry.read(), header.dtype).reshape(header.shape)

    def read_columns(self, name: str, count: int, widths: Collection[int]) -> np.ndarray:
        """Read the first `count` columns of an array (N, columns) or (N, J, 3) as float64. The number of
        columns must be in `widths`."""
        header = self.read_header(name)
        shape = header.shape
        flat = len(shape) == 2 or (len(shape) == 3 and shape[2] == 3 and not header.fortran)
        rows, width = (shape[0], math.prod(shape[1:])) if flat else (0, 0)
        if header.dtype.kind != "f" or width not in widths:
            expected = " or ".join(f"(N, {width})" for width in widths)
            raise InputError(f"{self.path}: {name} has type and shape {header}; must be floats {expected}")
        if not 0 < rows <= MAX_ROWS:
            raise InputError(
                f"{self.path}: {name} has type and shape {header}; must have 1 to {MAX_ROWS} frames"
            )
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
def _open_npz(path: Path) -> Iterator[_NpzReader]:
    """Open an npz file. Damaged bytes raise InputError within the whole context."""
    try:
        with open(path, "rb") as raw:
            magic = raw.read(2)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if magic != b"PK":
        raise InputError(f"{path}: not a zip, so not an npz file; convert BVH files with memmlp data import")
    try:
        with zipfile.ZipFile(path) as archive:
            yield _NpzReader(path, archive)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: cannot be read as npz ({_shorten_error(error)})") from error


def _shorten_error(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__


def _parse_header(start: bytes) -> _Header:
    """Parse an npy header from the first bytes of the file. Any exception means a damaged header."""
    stream = io.BytesIO(start)
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"an npy header of version {version}")
    with warnings.catch_warnings():  # about headers written by Python 2, and about unusual escapes
        warnings.simplefilter("ignore")
        shape, fortran, dtype = readers[version](stream, max_header_size=MAX_HEADER)
    return _Header(shape, fortran, dtype, stream.tell())


def _read_lines(
    entry: IO[bytes], dtype: np.dtype, count: int, length: int
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield blocks (n, length) of `count` rows, each with the index of its first row."""
    step = max(1, BLOCK // (length * dtype.itemsize))
    for start in range(0, count, step):
        lines = min(step, count - start)
        data = entry.read(lines * length * dtype.itemsize)
        yield start, np.frombuffer(data, dtype).reshape(lines, length)
