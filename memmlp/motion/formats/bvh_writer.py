"""Writes clips as BVH: 22 joints and their end sites, centimetres, Y up, the body's T-pose as zero pose.

`memmlp data import` knows the joints (`importing/skeletons/smpl_words.yaml`); `memmlp.yaml` there also gives
the axes, for clips in which nobody stands up.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from memmlp.common.files import atomic_file
from memmlp.motion.body import JOINTS, PARENTS
from memmlp.motion.clip import Clip
from memmlp.motion.formats.y_up import y_up_motion

CENTIMETRES = 100.0  # in a metre
NUMBER = "%.6f"  # 1e-8 m and 1e-6 degrees: below what float32 keeps of a clip
CHANNELS = "Zrotation Xrotation Yrotation"
TIPS = {
    "left_foot": (0.0, 0.0, 0.06), "right_foot": (0.0, 0.0, 0.06), "head": (0.0, 0.18, 0.0),
    "left_wrist": (0.17, 0.0, 0.0), "right_wrist": (-0.17, 0.0, 0.0),
}  # fmt: skip
"""From the last joints to the tips of toes, head and fingers, metres, body frame: bones are drawn to them."""


def write_bvh(path: Path, clip: Clip, rest: np.ndarray) -> None:
    """Write a clip on a body with these rest joints (22, 3), metres, atomically."""
    with atomic_file(path) as file:
        file.writelines(
            f"{line}\n".encode() for lines in (_hierarchy(rest), _motion(clip, rest)) for line in lines
        )


def euler_zxy(rotations: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
    """Return angles (N, ..., 3), degrees, with Rz Rx Ry = rotations (N, ..., 3, 3).

    Several triples of angles give the same rotation (two, and full turns). Each frame has the triple nearest
    to the frame before, so that a program may interpolate between frames. In gimbal lock, where only the sum
    of the outer angles counts, the product is still the rotation. The first frame's triple is near the angles
    (..., 3) `before` it, if there are some.
    """
    z = np.arctan2(-rotations[..., 0, 1], rotations[..., 1, 1])
    cosine, sine = np.cos(z)[..., None], np.sin(z)[..., None]
    first = cosine * rotations[..., 0, :] + sine * rotations[..., 1, :]  # rows of Rz^T R = Rx Ry
    second = cosine * rotations[..., 1, :] - sine * rotations[..., 0, :]
    x = np.arctan2(rotations[..., 2, 1], second[..., 1])
    y = np.arctan2(first[..., 2], first[..., 0])
    angles = np.stack([z, x, y], -1)
    if before is None:
        return np.degrees(_continuous(angles))
    return np.degrees(_continuous(np.concatenate([np.radians(before)[None], angles]))[1:])


def _continuous(angles: np.ndarray) -> np.ndarray:
    """Return the same rotations by angles Z X Y (N, ..., 3), radians, without jumps between frames."""
    steps = _turned(angles[1:] - angles[:-1])
    other = _turned(_second(angles[1:]) - angles[:-1])
    changes = np.abs(other).sum(-1) < np.abs(steps).sum(-1)
    second = np.zeros(angles.shape[:-1], bool)
    second[1:] = np.cumsum(changes, axis=0) % 2  # a change from the second triple leads back to the first
    return np.unwrap(np.where(second[..., None], _second(angles), angles), axis=0)


def _second(angles: np.ndarray) -> np.ndarray:
    """Return the other triple (..., 3), radians, of the same rotation Z X Y."""
    return np.array([np.pi, np.pi, np.pi]) + np.array([1, -1, 1]) * angles


def _turned(angles: np.ndarray) -> np.ndarray:
    """Return angles (...), radians, without full turns, -pi to pi."""
    return np.remainder(angles + np.pi, 2 * np.pi) - np.pi


def _hierarchy(rest: np.ndarray) -> Iterator[str]:
    """Yield the lines from HIERARCHY to the root's last brace."""
    yield "HIERARCHY"
    yield from _joint(0, rest, "")


def _joint(joint: int, rest: np.ndarray, indent: str) -> Iterator[str]:
    """Yield the lines of a joint and of all joints below it.

    The root's offset is zero, since some programs add it to the position channels and others do not.
    """
    offset = rest[joint] - rest[max(PARENTS[joint], 0)]
    position = "" if joint else "Xposition Yposition Zposition "
    yield f"{indent}{'JOINT' if joint else 'ROOT'} {JOINTS[joint]}"
    yield f"{indent}{{"
    yield f"{indent}\tOFFSET {_centimetres(offset)}"
    yield f"{indent}\tCHANNELS {3 if joint else 6} {position}{CHANNELS}"
    for child in _children(joint):
        yield from _joint(child, rest, indent + "\t")
    if JOINTS[joint] in TIPS:
        tip = _centimetres(np.array(TIPS[JOINTS[joint]]))
        yield from (f"{indent}\t{line}" for line in ("End Site", "{", f"\tOFFSET {tip}", "}"))
    yield f"{indent}}}"


def _children(joint: int) -> list[int]:
    return [child for child, parent in enumerate(PARENTS) if parent == joint]


def _below(joint: int) -> Iterator[int]:
    """Yield a joint and all joints below it, in the hierarchy's order."""
    yield joint
    for child in _children(joint):
        yield from _below(child)


def _centimetres(metres: np.ndarray) -> str:
    return " ".join(NUMBER % value for value in CENTIMETRES * metres)


def _motion(clip: Clip, rest: np.ndarray) -> Iterator[str]:
    """Yield the lines from MOTION on."""
    yield from ("MOTION", f"Frames: {len(clip)}", f"Frame Time: {1 / clip.fps:.12f}")
    order, before = list(_below(0)), None
    for piece in clip.pieces():
        rotations, root = y_up_motion(piece, rest)
        angles = euler_zxy(rotations, before)
        before = angles[-1]
        values = np.concatenate([CENTIMETRES * root, angles[:, order].reshape(len(piece), -1)], 1)
        form = " ".join([NUMBER] * values.shape[1])
        yield from (form % tuple(row) for row in values.tolist())
