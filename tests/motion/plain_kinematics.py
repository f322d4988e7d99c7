"""BVH text posed by plain NumPy, beside the package."""

from __future__ import annotations

from pathlib import Path

import numpy as np


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
