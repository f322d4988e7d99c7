"""A person who moves smoothly, and streams of that motion, for tests of memmlp.live."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import tiny
import torch

from memmlp.live.stream import BodyFrame, Pose, Stream
from memmlp.motion.body import TRACKED
from memmlp.motion.geometry import axis_angle_to_matrix, compute_motion_frames, forward_kinematics
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.motion_model import MotionModel


def at_ease(network: MotionModel, frames: torch.Tensor) -> MotionModel:
    """Let a network with random weights predict poses about the mean of frames (N, 252)."""
    network.normalizer = Normalizer.fit(network.normalizer.coordinates, tiny.REST, frames)
    return network


def body_frame(
    time: float, local: np.ndarray, positions: np.ndarray, rest: np.ndarray, restarted: bool = False
) -> BodyFrame:
    """A frame for outputs, of a wearer of the network's size."""
    return BodyFrame(time, local, positions, positions, rest, 1.0, (), True, restarted)


class Person(NamedTuple):
    """Trackers and truth: positions (N, 3, 3), rotations (N, 3, 3, 3), frames (N - 1, 252) as at 60 Hz."""

    positions: np.ndarray
    rotations: np.ndarray
    frames: torch.Tensor


def person(times: np.ndarray) -> Person:
    """At times (N,), seconds: steps and turns at walking speed, arms that swing; float64."""
    random = np.random.default_rng(1)
    rate, phase = random.uniform(0.3, 1.2, (2, 22, 3)), random.uniform(0, 6, (2, 22, 3))
    t = np.asarray(times)[:, None, None]
    poses = sum(0.25 * np.sin(2 * np.pi * rate[i] * t + phase[i]) for i in range(2))
    poses[:, 0] = np.array([np.pi / 2, 0, 0]) + 0.2 * poses[:, 0]
    t = t[:, 0]
    trans = np.concatenate([0.8 * np.sin(t), 0.6 * np.cos(1.3 * t), 0.95 + 0.02 * np.sin(9 * t)], 1)
    return of_poses(torch.tensor(poses), torch.tensor(trans))


def of_poses(poses: torch.Tensor, trans: torch.Tensor) -> Person:
    """Of a clip's axis-angle poses (N, 22, 3) and translation (N, 3)."""
    local = axis_angle_to_matrix(poses)
    rotations, positions = forward_kinematics(local, trans + tiny.REST[0], tiny.REST)
    tracked = list(TRACKED)
    frames = compute_motion_frames(poses, trans, tiny.REST).float()
    return Person(positions[:, tracked].numpy(), rotations[:, tracked].numpy(), frames)


def play(
    stream: Stream,
    positions: np.ndarray,
    rotations: np.ndarray,
    times: Sequence[float] | np.ndarray | None = None,
    lost: dict[int, Sequence[int]] | None = None,
) -> list[Pose]:
    """The poses of a stream of trackers; lost: which trackers at which samples."""
    poses = []
    for index, sample in enumerate(zip(positions, rotations, strict=True)):
        gone = (lost or {}).get(index, ())
        trackers = [None if k in gone else (sample[0][k], sample[1][k]) for k in range(3)]
        poses.append(stream.step(*trackers, None if times is None else float(times[index])))
    return poses


def joints(poses: Sequence[Pose]) -> np.ndarray:
    """Positions (N, 22, 3) of poses."""
    return np.stack([pose.positions for pose in poses])


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Mean distance (N,) of joints (N, 22, 3), cm."""
    return 100 * np.linalg.norm(a - b, axis=-1).mean(-1)


def fastest(positions: np.ndarray) -> float:
    """The fastest joint's speed in positions (N, 22, 3) at 60 Hz, cm/s."""
    return float(6000 * np.linalg.norm(np.diff(positions, axis=0), axis=-1).max())
