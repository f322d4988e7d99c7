"""BVH text and npz files posed by plain NumPy, beside the package: what an import is checked with."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from memmlp.motion.body import JOINTS, PARENTS, builtin_rest_joints

CHAINS = (
    "pelvis spine1 spine2 spine3 neck head",
    "left_hip left_knee left_ankle left_foot",
    "right_hip right_knee right_ankle right_foot",
    "left_collar left_shoulder left_elbow left_wrist",
    "right_collar right_shoulder right_elbow right_wrist",
    "right_hip left_hip",
)
"""Joints whose lines to the next one that the file has must point as in the file."""


def bvh_positions(path: Path) -> dict[str, np.ndarray]:
    """Pose a BVH file: each joint's and end site's positions (N, 3), in the file's unit and axes."""
    words = path.read_text().split()
    at = words.index("MOTION")
    rows = np.array(words[words.index("Time:") + 2 :], float).reshape(int(words[at + 2]), -1)
    words = words[:at]
    positions: dict[str, np.ndarray] = {}
    rotations: dict[str, np.ndarray] = {}
    open_joints: list[str] = []
    name, column = "", 0
    for index, word in enumerate(words):
        if word in ("ROOT", "JOINT"):
            name = words[index + 1]
        elif word == "End":
            name = open_joints[-1] + ".end"
        elif word == "{":
            open_joints.append(name)
        elif word == "}":
            open_joints.pop()
        elif word == "OFFSET":
            shift = np.tile(np.array(words[index + 1 : index + 4], float), (len(rows), 1))
            channels = []
            if words[index + 4] == "CHANNELS":
                channels = words[index + 6 : index + 6 + int(words[index + 5])]
            local = np.tile(np.eye(3), (len(rows), 1, 1))
            for channel in channels:
                axis = "XYZ".index(channel[0])
                if channel.endswith("position"):
                    shift[:, axis] = rows[:, column]
                else:
                    local = local @ about(axis, np.radians(rows[:, column]))
                column += 1
            if len(open_joints) == 1:
                positions[name], rotations[name] = shift, local
            else:
                above = open_joints[-2]
                positions[name] = positions[above] + np.einsum("nij,nj->ni", rotations[above], shift)
                rotations[name] = rotations[above] @ local
    return positions


def about(axis: int, angles: np.ndarray) -> np.ndarray:
    """Rotations (N, 3, 3) about a coordinate axis."""
    result = np.zeros((len(angles), 3, 3))
    result[:, axis, axis] = 1
    a, b = (axis + 1) % 3, (axis + 2) % 3
    result[:, a, a] = result[:, b, b] = np.cos(angles)
    result[:, b, a] = np.sin(angles)
    result[:, a, b] = -np.sin(angles)
    return result


def npz_kinematics(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Pose an AMASS file on the built-in body: global rotations (N, 22, 3, 3) and positions (N, 22, 3)."""
    rest = builtin_rest_joints()
    with np.load(path) as file:
        vectors, trans = file["poses"][:, :66].reshape(-1, 22, 3).astype(float), file["trans"].astype(float)
    rotations = rodrigues(vectors)
    positions = np.tile(rest[0] + trans[:, None], (1, 22, 1))
    for joint, parent in enumerate(PARENTS[1:], start=1):
        rotations[:, joint] = rotations[:, parent] @ rotations[:, joint]
        positions[:, joint] = positions[:, parent] + rotations[:, parent] @ (rest[joint] - rest[parent])
    return rotations, positions


def rodrigues(vectors: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3) of axis-angle vectors (..., 3), by Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
    safe = np.where(angle > 1e-12, angle, 1.0)
    return np.eye(3) + np.sin(angle) / safe * cross + (1 - np.cos(angle)) / safe**2 * (cross @ cross)


def to_world(positions: np.ndarray, up: str) -> np.ndarray:
    """Turn positions (..., 3) of a Y-up or Z-up file into the world, Z up."""
    return (
        positions if up == "z" else np.stack([positions[..., 0], -positions[..., 2], positions[..., 1]], -1)
    )


def worst_direction(npz: Path, file: dict[str, np.ndarray], joints: dict[str, str]) -> tuple[float, str]:
    """The largest angle, degrees, between a segment on the body and in the file (world), and its name."""
    body, worst = npz_kinematics(npz)[1], (0.0, "")
    for chain in CHAINS:
        mapped = [joint for joint in chain.split() if joint in joints]
        for start, end in pairwise(mapped):
            there = file[joints[end]] - file[joints[start]]
            here = body[:, JOINTS.index(end)] - body[:, JOINTS.index(start)]
            if np.linalg.norm(there, axis=-1).min() < 1e-9:
                continue
            lengths = np.linalg.norm(there, axis=-1) * np.linalg.norm(here, axis=-1)
            cosine = ((there * here).sum(-1) / lengths).clip(-1, 1)
            worst = max(worst, (float(np.degrees(np.arccos(cosine)).max()), f"{start} to {end}"))
    return worst


def worst_distance(
    npz: Path, file: dict[str, np.ndarray], joints: dict[str, str], unit: float
) -> tuple[float, str]:
    """The largest distance, mm, between a joint in the file and where a clip's rotations put it on its bones.

    A bone's direction from its joint is that of the first frame, and its length that of each frame.
    """
    rotations, worst = npz_kinematics(npz)[0], (0.0, "")
    posed = {"pelvis": file[joints["pelvis"]] * unit}
    for joint, name in enumerate(JOINTS[1:], start=1):
        if name not in joints:
            continue
        parent = PARENTS[joint]
        while JOINTS[parent] not in joints:
            parent = PARENTS[parent]
        bone = (file[joints[name]] - file[joints[JOINTS[parent]]]) * unit
        length = np.linalg.norm(bone, axis=-1, keepdims=True)
        own = rotations[0, parent].T @ (bone[0] / max(length[0, 0], 1e-9))
        posed[name] = posed[JOINTS[parent]] + rotations[:, parent] @ own * length
        off = 1000 * np.linalg.norm(posed[name] - file[joints[name]] * unit, axis=-1)
        worst = max(worst, (float(off.max()), name))
    return worst
