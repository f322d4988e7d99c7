"""The files that can be imported, by suffix and first line: BVH, and exponential maps of the CMU layout."""

from __future__ import annotations

from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.formats.expmap import PUBLISHED_FPS, read_expmap
from memmlp.motion.importing.motion_file import MotionFile

BVH, EXPMAP = ".bvh", ".txt"
COLUMNS = 90  # numbers in a first line that only exponential maps have; other text files are passed over
ALLOWED = "a .bvh file, a .txt file of exponential maps, or a folder with some in it"
FIRST_LINE = 10_000  # bytes of a file that are looked at for that


def find_recordings(source: Path) -> dict[Path, Path]:
    """Find the recordings of a folder, or a single one: sorted, by their path below the folder.

    Raises:
        InputError: if there is none.
    """
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; allowed: {ALLOWED}")
    top = source if source.is_dir() else source.parent
    paths = sorted(source.rglob("*")) if source.is_dir() else [source]
    files = {path.relative_to(top): path for path in paths if path.is_file() and _is_recording(path)}
    if not files:
        raise InputError(f"{source}: no recording found; allowed: {ALLOWED}")
    return files


def read_recording(path: Path) -> MotionFile:
    """Read a recording; if its format has no frame rate (`tells_rate`), it gets that of the published files.

    Raises:
        InputError: if the file is damaged.
    """
    return read_bvh(path) if tells_rate(path) else read_expmap(path, PUBLISHED_FPS)


def tells_rate(path: Path) -> bool:
    """Return whether a file's format states its frame rate."""
    return path.suffix.lower() == BVH


def _is_recording(path: Path) -> bool:
    """Return whether a file is a BVH, by its name, or has exponential maps, by its first line."""
    suffix = path.suffix.lower()
    return suffix == BVH or (suffix == EXPMAP and _first_line(path).count(b",") >= COLUMNS)


def _first_line(path: Path) -> bytes:
    try:
        with open(path, "rb") as file:
            return file.readline(FIRST_LINE)
    except OSError:
        return b""
