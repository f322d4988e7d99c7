"""A test of a long stream: whether it stays finite, keeps its accuracy, and does not use more memory."""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from memmlp.common.progress import progress_bar
from memmlp.live.stream import Stream
from memmlp.motion.body import FPS

TENTHS = 10


class TrackedMotion(NamedTuple):
    """Trackers and true joints of a motion, in AMASS' world.

    Attributes:
        positions: of head, left and right wrist (N, 3, 3), metres.
        rotations: of head, left and right wrist (N, 3, 3, 3).
        joints: the true joints (N, 22, 3), metres.
    """

    positions: np.ndarray
    rotations: np.ndarray
    joints: np.ndarray


class Soaked(NamedTuple):
    """The result of a long stream.

    Attributes:
        frames: number of frames.
        finite: whether every number of every pose was finite.
        errors: the joints' mean distance from the truth in each tenth, cm.
        growth: growth of the process's memory, from the end of the first tenth to the end, bytes.
    """

    frames: int
    finite: bool
    errors: list[float]
    growth: int


def repetitions(length: int, least: int) -> int:
    """Return how often to repeat a motion of `length` frames to get at least `least` frames.

    The number is a multiple of ten, so that every tenth of the stream has the same frames.
    """
    return TENTHS * -(-least // (TENTHS * length))


def soak(stream: Stream, motion: TrackedMotion, times: int) -> Soaked:
    """Stream a motion `times` times in a row, a multiple of ten, without a reset or a gap in between.

    Each tenth holds the same frames. Only their beginnings differ: the first repetition starts fresh, and
    every later one starts with a jump from the motion's end.
    """
    length, finite, errors, size = len(motion.joints), True, np.zeros(TENTHS), 0
    total = length * times
    for index in progress_bar(range(total), "soak"):
        at, tenth = index % length, index * TENTHS // total
        head, left, right = zip(motion.positions[at], motion.rotations[at], strict=True)
        pose = stream.step(head, left, right, index / FPS)
        finite &= bool(np.isfinite(pose.positions).all() and np.isfinite(pose.position_branch).all())
        finite &= bool(np.isfinite(pose.rotations).all())
        errors[tenth] += 100 * float(np.sqrt(((pose.positions - motion.joints[at]) ** 2).sum(-1)).mean())
        if (index + 1) * TENTHS == total:
            size = memory()
    return Soaked(total, finite, (errors * TENTHS / total).tolist(), memory() - size)


def memory() -> int:
    """Return the process's memory in bytes; if the system does not tell it, the most that it has had."""
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text().split()[1]) * resource.getpagesize()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
