"""BVH text posed by plain NumPy, beside the package."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation


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
                if channel.endswith("position"):
                    shift[:, "XYZ".index(channel[0])] = rows[:, column]
                else:
                    local = (
                        local
                        @ Rotation.from_euler(channel[0].lower(), rows[:, [column]], degrees=True).as_matrix()
                    )
                column += 1
            if len(open_joints) == 1:
                positions[name], rotations[name] = shift, local
            else:
                above = open_joints[-2]
                positions[name] = positions[above] + np.einsum("nij,nj->ni", rotations[above], shift)
                rotations[name] = rotations[above] @ local
    return positions
