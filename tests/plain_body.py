"""A body posed joint by joint in NumPy, to compare the package's kinematics with."""

import numpy as np
import tiny

from memmlp.motion.body import PARENTS


def posed(rotation: np.ndarray) -> np.ndarray:
    """Return the joints (22, 3) of local 6D rotations (132,), the pelvis at the origin."""
    turns, places = [], []
    for joint, sixd in enumerate(rotation.reshape(22, 2, 3).astype(np.float64)):
        x = sixd[0] / np.linalg.norm(sixd[0])
        y = sixd[1] - (x @ sixd[1]) * x
        y /= np.linalg.norm(y)
        local, parent = np.stack([x, y, np.cross(x, y)], 1), PARENTS[joint]
        rest = tiny.REST.numpy()
        turns.append(local if parent < 0 else turns[parent] @ local)
        places.append(
            np.zeros(3) if parent < 0 else places[parent] + turns[parent] @ (rest[joint] - rest[parent])
        )
    return np.array(places)
