"""Finds and reads recordings, and finds their true frame rates.

`READERS` has the formats, by suffix. A further format is one module in `memmlp.motion.formats` with a
function `read(path) -> Recording`, and its entry here.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import yaml

from memmlp.common.errors import InputError
from memmlp.motion.formats.asf_amc import read_amc
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.formats.recording import Recording

READERS: dict[str, Callable[[Path], Recording]] = {".bvh": read_bvh, ".amc": read_amc}
EXPECTED = f"expected a {' or '.join(READERS)} file, or a folder with some in it"
HEADER = "the header's"
DIGITS = 16  # of a file's digest, by which its true rate is known


class Rate(NamedTuple):
    """A frame rate.

    Attributes:
        fps: frames per second.
        reason: a description of the rate's origin.
    """

    fps: float
    reason: str


DATABASES = Rate(120.0, "of CMU and HDM05, as AMC files do not state a rate")


def find_recordings(source: Path) -> dict[Path, Path]:
    """Find the recordings of a folder, or a single one: sorted, by their path below the folder.

    Raises:
        InputError: if it is missing, or has none.
    """
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; {EXPECTED}")
    top = source if source.is_dir() else source.parent
    paths = sorted(source.rglob("*")) if source.is_dir() else [source]
    files = {p.relative_to(top): p for p in paths if p.suffix.lower() in READERS and p.is_file()}
    if not files:
        raise InputError(f"{source}: no recording found; {EXPECTED}")
    return files


def read_recording(path: Path) -> Recording:
    """Read a recording. Raises InputError if the file is damaged, or of another format."""
    if path.suffix.lower() not in READERS:
        raise InputError(f"{path}: {EXPECTED}")
    return READERS[path.suffix.lower()](path)


def find_rate(recording: Recording, relative: Path, given: Mapping[str, float]) -> Rate:
    """Return a recording's true frame rate: given by the user, known of the file, the header's, or 120 Hz.

    Args:
        recording: the recording.
        relative: the file's path below the imported folder.
        given: rates by folder below that folder ("" for all).
    """
    for folder in relative.parents:
        if (key := folder_key(folder)) in given:
            return Rate(float(given[key]), f"given for {key or 'all'}")
    plain = recording.path.read_bytes().replace(b"\r\n", b"\n")  # whatever line ends a tool gave the file
    known = _load_known_rates().get(hashlib.sha256(plain).hexdigest()[:DIGITS])
    if known is not None:
        return Rate(known, "known of this file")
    if recording.fps is None:
        return DATABASES
    return Rate(recording.fps, HEADER)


def folder_key(folder: Path) -> str:
    """Return the name of a folder below the imported one for `--fps`; "" for the imported folder itself."""
    return "" if folder == Path() else folder.as_posix()


@cache
def _load_known_rates() -> dict[str, float]:
    path = Path(__file__).with_name("known_rates.yaml")
    return {digest: float(fps) for digest, fps in yaml.safe_load(path.read_text("utf-8")).items()}
