"""The formats that clips are written in, by name and by suffix."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.clip import Clip
from memmlp.motion.formats.bvh_writer import write_bvh
from memmlp.motion.formats.gltf_writer import write_gltf
from memmlp.motion.formats.npz import write_clip


class Format(NamedTuple):
    """A format that clips are written in.

    Attributes:
        suffix: the suffix of the format's files.
        write: writes a clip on a body with rest joints (22, 3), metres, atomically.
        has_bones: whether the file contains the body.
    """

    suffix: str
    write: Callable[[Path, Clip, np.ndarray], None]
    has_bones: bool = True


def _write_npz(path: Path, clip: Clip, rest: np.ndarray) -> None:
    """Write AMASS' npz, which has no bones; its readers supply the body."""
    write_clip(path, clip)


FORMATS = {
    "bvh": Format(".bvh", write_bvh),
    "npz": Format(".npz", _write_npz, has_bones=False),
    "gltf": Format(".glb", write_gltf),
}
SUFFIXES = {each.suffix: each for each in FORMATS.values()}


def format_of(path: Path, key: str = "path") -> Format:
    """Return the format that belongs to a file's suffix.

    Raises:
        InputError: for any other suffix; its message names the path by `key`, the option or argument.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{key} {path}: no such kind of file; allowed: {', '.join(SUFFIXES)}")
    return SUFFIXES[path.suffix.lower()]


def write_motion(path: Path, clip: Clip, rest: np.ndarray, chosen: Format) -> None:
    """Write a clip in a format, atomically; missing folders are made.

    Raises:
        InputError: if the file cannot be written there.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        chosen.write(path, clip, rest)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); allowed: a file to write") from error
