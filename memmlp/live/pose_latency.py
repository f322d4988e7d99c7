"""The time of a whole pose on a CPU: from a sample of the trackers to the joints in the caller's space."""

from __future__ import annotations

import time
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np

from memmlp.common.processes import CoreClock
from memmlp.deploy.latency import SETTLING, WARM_UP, InTurn, in_turn
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.live.rotations import quaternion_to_matrix
from memmlp.live.stream import Stream
from memmlp.motion.body import SPARSE_DIM

Key = TypeVar("Key", bound=Hashable)
LEAST = 200  # samples that are timed, at least


def measure_pose(path: Path, steps: int) -> dict[str, float]:
    """Time whole poses of an exported network on one thread: median and 95th percentile, in milliseconds.

    A pose is a call of `Stream.step`: features, conversions, forward kinematics and the network's step.
    Unlike in `measure_step`, no yardstick runs in between. So a small network stays in the caches, and its
    whole pose may take less time than its step does there. `pose_core_share` is the share of that time in
    which the thread had a core.
    """
    stream, clock = Stream(path), CoreClock()
    seconds = alternate(stream, None, WARM_UP + max(steps, LEAST))[WARM_UP:, 1]
    return {
        "pose_median_ms": 1000 * float(np.median(seconds)),
        "pose_p95_ms": 1000 * float(np.percentile(seconds, 95)),
        "pose_core_share": clock.share,
    }


def time_poses_in_turn(paths: Mapping[Key, Path], rounds: int, steps: int) -> dict[Key, InTurn]:
    """Time whole poses of exported networks on one thread, with all files in turn in each round.

    The first poses of a round are left out.
    """
    streams = {key: Stream(path) for key, path in paths.items()}
    return in_turn(paths, rounds, lambda key: alternate(streams[key], None, SETTLING + steps)[SETTLING:, 1])


def alternate(stream: Stream, network: OnnxStream | None, frames: int) -> np.ndarray:
    """Time the network's step alone and the stream's step in alternation, on random trackers.

    Args:
        stream: the stream.
        network: the network; None to time the stream alone.
        frames: number of samples.

    Returns:
        Seconds (frames, 2): of the network's step, and of the stream's.
    """
    random, seconds = np.random.default_rng(0), np.zeros((frames, 2))
    sparse = random.standard_normal((frames, 1, SPARSE_DIM), np.float32)
    quaternions = random.normal(size=(frames, 3, 4))
    rotations = quaternion_to_matrix(quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True))
    positions = random.normal(size=(frames, 3, 3))
    for index in range(frames):
        start = time.perf_counter()
        if network is not None:
            network.step(sparse[index])
        middle = time.perf_counter()
        head, left, right = zip(positions[index], rotations[index], strict=True)
        stream.step(head, left, right)
        seconds[index] = middle - start, time.perf_counter() - middle
    return seconds
