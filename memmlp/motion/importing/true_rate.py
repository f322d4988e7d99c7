"""A recording's true frame rate: given by the user, by a file beside the data, by a list, or its header."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import yaml

from memmlp.common.errors import InputError, why_unreadable
from memmlp.motion.clip import FRAME_RATE_RANGE
from memmlp.motion.importing.skeleton_map import is_number

SIDECAR = "motion.yaml"  # beside the files or in a folder above them; `fps: 60` is what it may hold
HEADER = "the header's"
DIGITS = 16  # of a file's digest, by which it is known


class Rate(NamedTuple):
    """A frame rate.

    Attributes:
        fps: frames per second.
        reason: where the rate is from, in words.
    """

    fps: float
    reason: str


def true_rate(header: float, relative: Path, content: bytes, top: Path, told: Mapping[str, float]) -> Rate:
    """Return a file's frame rate.

    Args:
        header: the rate in the file's header, Hz.
        relative: the file's path below `top`.
        content: the file's bytes.
        top: the folder that is imported.
        told: rates by folder below `top` ("" for all), which override everything else.

    Raises:
        InputError: if a folder's `motion.yaml` is damaged.
    """
    for folder in relative.parents:
        if folder_key(folder) in told:
            return Rate(float(told[folder_key(folder)]), f"given for {folder_key(folder) or 'all'}")
    for folder in relative.parents:
        fps = _sidecar(top / folder / SIDECAR)
        if fps is not None:
            return Rate(fps, f"in {(folder / SIDECAR).as_posix()}")
    known = _known().get(_digest(content))
    return Rate(header, HEADER) if known is None else Rate(known, "known of this file")


def _digest(content: bytes) -> str:
    """Return the first digits of a file's digest, the same whatever ends of lines a tool gave the file."""
    return hashlib.sha256(content.replace(b"\r\n", b"\n")).hexdigest()[:DIGITS]


def folder_key(folder: Path) -> str:
    """Return a folder below the imported one as `--fps` names it; "" for the imported folder itself."""
    return "" if folder == Path() else folder.as_posix()


@cache
def _known() -> dict[str, float]:
    """Return the true rates of files with wrong headers, by the first digits of their digests."""
    path = Path(__file__).with_name("known_rates.yaml")
    return {digest: float(fps) for digest, fps in yaml.safe_load(path.read_text("utf-8")).items()}


def _sidecar(path: Path) -> float | None:
    """Return the rate in a folder's `motion.yaml`; None if there is no such file."""
    if not path.is_file():
        return None
    try:
        content = yaml.safe_load(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise InputError(f"{path}: {why_unreadable(error)[:120]}; allowed: readable YAML") from error
    good = (
        isinstance(content, dict) and set(content) == {"fps"} and is_number(content["fps"], *FRAME_RATE_RANGE)
    )
    if not good:
        raise InputError(f"{path}: no frame rate; allowed: fps, 1 to 1000 Hz, and nothing else")
    return float(content["fps"])
