"""The time of an end-to-end pose on a CPU: from the trackers' sample to joints in the caller's space."""

from __future__ import annotations

import time
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np

from memmlp.common.processes import CoreUsageTimer
from memmlp.deploy.latency import SETTLING, WARM_UP, InTurn, in_turn
from memmlp.live.rotations import quaternion_to_matrix
from memmlp.live.stream import Stream

Key = TypeVar("Key", bound=Hashable)
LEAST = 200  # samples that are timed, at least


def measure_pose(path: Path, steps: int) -> dict[str, float]:
    """Time end-to-end poses of an exported network on one thread: median and 95th percentile, milliseconds.

    A pose is a call of `Stream.step`: features, conversions, forward kinematics and the network's step.
    Unlike in `measure_step`, no yardstick runs in between. So a small network stays in the caches, and its
    pose may take less time than its step does there. `pose_core_share` is the share of that time in which the
    thread had a core.
    """
    stream, clock = Stream(path), CoreUsageTimer()
    seconds = time_poses(stream, WARM_UP + max(steps, LEAST))[WARM_UP:]
    return {
        "pose_median_ms": 1000 * float(np.median(seconds)),
        "pose_p95_ms": 1000 * float(np.percentile(seconds, 95)),
        "pose_core_share": clock.fraction,
    }


def time_poses_in_turn(paths: Mapping[Key, Path], rounds: int, steps: int) -> dict[Key, InTurn]:
    """Time end-to-end poses of exported networks on one thread, with all files in turn in each round.

    The first poses of a round are left out.
    """
    streams = {key: Stream(path) for key, path in paths.items()}
    return in_turn(paths, rounds, lambda key: time_poses(streams[key], SETTLING + steps)[SETTLING:])


def time_poses(stream: Stream, count: int) -> np.ndarray:
    """Return the seconds (count,) of each of the stream's steps, on random trackers."""
    random, seconds = np.random.default_rng(0), np.zeros(count)
    quaternions = random.normal(size=(count, 3, 4))
    rotations = quaternion_to_matrix(quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True))
    positions = random.normal(size=(count, 3, 3))
    for index in range(count):
        head, left, right = zip(positions[index], rotations[index], strict=True)
        start = time.perf_counter()
        stream.step(head, left, right)
        seconds[index] = time.perf_counter() - start
    return seconds
