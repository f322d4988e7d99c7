"""A long stream: does it stay finite, as good as it was, and as small."""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from memmlp.common.progress import track
from memmlp.live.stream import Stream
from memmlp.motion.body import FPS

TENTHS = 10


class TrackedMotion(NamedTuple):
    """Trackers and the truth: (N, 3, 3) metres, (N, 3, 3, 3), and joints (N, 22, 3), AMASS' world."""

    positions: np.ndarray
    rotations: np.ndarray
    joints: np.ndarray


class Soaked(NamedTuple):
    """What came of it.

    Attributes:
        frames: how many. finite: whether every number of every pose was.
        errors: mean distance of the joints from the truth, cm, in each tenth.
        growth: of the process' memory from the end of the first tenth to the end, bytes.
    """

    frames: int
    finite: bool
    errors: list[float]
    growth: int


def repetitions(length: int, least: int) -> int:
    """How often a motion of `length` frames makes at least `least`, with the same frames in every tenth."""
    return TENTHS * -(-least // (TENTHS * length))


def soak(stream: Stream, motion: TrackedMotion, times: int) -> Soaked:
    """Stream a motion `times` times in a row, a multiple of ten, without a reset or a gap in between.

    Each tenth holds the same frames. What is not the same is how the first of all begins: fresh, while every
    later repetition begins with a jump from the motion's end.
    """
    length, finite, errors, size = len(motion.joints), True, np.zeros(TENTHS), 0
    total = length * times
    for index in track(range(total), "soak"):
        at, tenth = index % length, index * TENTHS // total
        head, left, right = zip(motion.positions[at], motion.rotations[at], strict=True)
        pose = stream.step(head, left, right, index / FPS)
        finite &= bool(np.isfinite(pose.positions).all() and np.isfinite(pose.joints).all())
        finite &= bool(np.isfinite(pose.rotations).all())
        errors[tenth] += 100 * float(np.sqrt(((pose.positions - motion.joints[at]) ** 2).sum(-1)).mean())
        if (index + 1) * TENTHS == total:
            size = memory()
    return Soaked(total, finite, (errors * TENTHS / total).tolist(), memory() - size)


def memory() -> int:
    """Bytes of memory that the process has; where the system does not tell, the most that it had."""
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text().split()[1]) * resource.getpagesize()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
