"""Finds and reads recordings, and finds their true frame rates.

A file that ends in `.bvh` is a BVH; a `.txt` whose first line has many numbers is exponential maps of the CMU
layout. The frame rate is given by the user, by a file beside the data, by a list of known files, or by the
header.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import yaml

from memmlp.common.errors import InputError, why_unreadable
from memmlp.motion.clip import FRAME_RATE_RANGE
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.formats.expmap import read_expmap
from memmlp.motion.formats.recording import Recording
from memmlp.motion.importing.skeleton_map import is_number

EXPECTED = "expected a .bvh file, a .txt file of exponential maps, or a folder with some in it"
COLUMNS = 90  # numbers in a first line that only exponential maps have; other text files are passed over
FIRST_LINE = 10_000  # bytes of a file that are read for that
SIDECAR = "motion.yaml"  # beside the files or in a folder above them; its content is like `fps: 60`
HEADER = "the header's"
DIGITS = 16  # of a file's digest, by which it is known


class Rate(NamedTuple):
    """A frame rate.

    Attributes:
        fps: frames per second.
        reason: a description of the rate's origin.
    """

    fps: float
    reason: str


def find_recordings(source: Path) -> dict[Path, Path]:
    """Find the recordings of a folder, or a single one: sorted, by their path below the folder.

    Raises:
        InputError: if it is missing.
    """
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; {EXPECTED}")
    top = source if source.is_dir() else source.parent
    paths = sorted(source.rglob("*")) if source.is_dir() else [source]
    files = {path.relative_to(top): path for path in paths if path.is_file() and _is_recording(path)}
    if not files:
        raise InputError(f"{source}: no recording found; {EXPECTED}")
    return files


def _is_recording(path: Path) -> bool:
    if states_rate(path) or path.suffix.lower() != ".txt":
        return states_rate(path)
    try:
        with open(path, "rb") as file:
            return file.readline(FIRST_LINE).count(b",") >= COLUMNS
    except OSError:
        return False


def read_recording(path: Path) -> Recording:
    """Read a recording; if its format has no frame rate (`states_rate`), it gets that of the published files.

    Raises:
        InputError: if the file is damaged.
    """
    return read_bvh(path) if states_rate(path) else read_expmap(path)


def states_rate(path: Path) -> bool:
    """Return whether a file's format states its frame rate."""
    return path.suffix.lower() == ".bvh"


def true_rate(header: float, relative: Path, content: bytes, top: Path, given: Mapping[str, float]) -> Rate:
    """Return a file's frame rate.

    Args:
        header: the rate in the file's header, Hz.
        relative: the file's path below `top`.
        content: the file's bytes.
        top: the folder that is imported.
        given: rates by folder below `top` ("" for all), which override everything else.

    Raises:
        InputError: if a folder's `motion.yaml` is damaged.
    """
    for folder in relative.parents:
        if (key := folder_key(folder)) in given:
            return Rate(float(given[key]), f"given for {key or 'all'}")
    for folder in relative.parents:
        if (fps := _read_sidecar(top / folder / SIDECAR)) is not None:
            return Rate(fps, f"in {(folder / SIDECAR).as_posix()}")
    plain = content.replace(b"\r\n", b"\n")  # whatever line ends a tool gave the file
    known = _known_rates().get(hashlib.sha256(plain).hexdigest()[:DIGITS])
    return Rate(header, HEADER) if known is None else Rate(known, "known of this file")


def folder_key(folder: Path) -> str:
    """Return the name of a folder below the imported one for `--fps`; "" for the imported folder itself."""
    return "" if folder == Path() else folder.as_posix()


@cache
def _known_rates() -> dict[str, float]:
    path = Path(__file__).with_name("known_rates.yaml")
    return {digest: float(fps) for digest, fps in yaml.safe_load(path.read_text("utf-8")).items()}


def _read_sidecar(path: Path) -> float | None:
    """Return the rate in a folder's `motion.yaml`; None if there is no such file."""
    if not path.is_file():
        return None
    try:
        content = yaml.safe_load(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise InputError(f"{path}: {why_unreadable(error)[:120]}; expected readable YAML") from error
    if not (
        isinstance(content, dict) and set(content) == {"fps"} and is_number(content["fps"], *FRAME_RATE_RANGE)
    ):
        raise InputError(f"{path}: must have fps, 1 to 1000 Hz, and nothing else")
    return float(content["fps"])
