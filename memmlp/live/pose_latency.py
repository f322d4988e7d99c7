"""CPU time of an end-to-end pose: from a sample of the trackers to joints in the caller's space."""

import time
from pathlib import Path

import numpy as np

from memmlp.common.processes import CoreUsageTimer
from memmlp.deploy.latency import WARM_UP, summarize_times
from memmlp.live.rotations import quaternion_to_matrix
from memmlp.live.stream import Stream

LEAST = 200  # minimum number of timed samples


def measure_pose_times(path: Path, steps: int) -> dict[str, float]:
    """Time end-to-end poses of an exported network on one thread: median and 95th percentile, milliseconds. A
    pose is one call of `Stream.step`: features, conversions, forward kinematics and the network's step.
    Unlike `measure_step_times`, this runs no yardstick between the poses, so a small network stays in the
    caches. `pose_core_share` is the fraction of the time in which the thread ran on a core."""
    stream, clock = Stream(path), CoreUsageTimer()
    seconds = time_poses(stream, WARM_UP + max(steps, LEAST))[WARM_UP:]
    return summarize_times("pose_", seconds) | {"pose_core_share": clock.fraction}


def time_poses(stream: Stream, count: int) -> np.ndarray:
    """Run steps of a stream on random trackers, and return the seconds (count,) of each step."""
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
