"""A site's clips: a few seconds of trackers and true joints, as small binary files."""

from __future__ import annotations

import gzip
import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.session.sources import TrackedClip
from memmlp.live.spaces import SPACES
from memmlp.motion.body import FPS

NUMBERS = 9 + 12 + 66
"""Numbers per frame: positions and quaternions (xyzw) of head and wrists, joints; metres, openxr axes."""


class SiteClip(NamedTuple):
    """A clip of a site.

    Attributes:
        key: the clip's name in files: a digest of its content.
        name: the clip's readable name.
        content: little-endian float32 (frames, 87).
    """

    key: str
    name: str
    content: bytes

    @property
    def frames(self) -> int:
        """Number of the clip's frames, at 60 Hz."""
        return len(self.content) // (4 * NUMBERS)


def packed(name: str, frames: np.ndarray, seconds: float) -> SiteClip:
    """Return the middle part of a clip.

    Args:
        name: the clip's name.
        frames: [X | Theta] (N, 252) at 60 Hz, world (`memmlp.motion.body`).
        seconds: the longest duration of the part.
    """
    count = min(len(frames), round(seconds * FPS))
    first = (len(frames) - count) // 2
    clip, space = TrackedClip(name, frames[first : first + count]), SPACES["openxr"]
    rotations = matrix_to_quaternion(space.rotations_out(clip.rotations).reshape(-1, 3, 3))
    parts = [space.positions_out(clip.positions), rotations, space.positions_out(clip.joints)]
    content = np.concatenate([part.reshape(count, -1) for part in parts], 1).astype("<f4").tobytes()
    return SiteClip(hashlib.sha256(content).hexdigest()[:12], name, content)


def write_clips(clips: Iterable[SiteClip], folder: Path) -> list[dict[str, Any]]:
    """Write clips into a site's folder, and return the entries that tell the page about them."""
    entries = []
    for clip in clips:
        path = folder / "clips" / f"{clip.key}.gz"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(gzip.compress(clip.content, 9, mtime=0))
        entries.append(
            {"key": clip.key, "name": clip.name, "file": f"clips/{path.name}", "frames": clip.frames}
        )
    return entries
