"""Write a clip's head and hands as the trackers.csv that the examples read.

    python trackers.py CLIP.npz --space unity --out trackers.csv

CLIP.npz is AMASS' format, as `memmlp data import` and `memmlp predict --branch truth` write it. The file has
a header and one row for each frame at 60 Hz: x, y, z in metres and a quaternion qx, qy, qz, qw of head, left
and right wrist. A headset's own recording in this form serves as well.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.spaces import SPACES, Space
from memmlp.motion.body import TRACKED, load_rest_joints
from memmlp.motion.clip import Clip, resample
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.geometry import axis_angle_to_matrix, forward_kinematics


def trackers(clip: Clip, rest: np.ndarray, space: Space) -> np.ndarray:
    """Return head, left and right (N, 3, 7), x y z qx qy qz qw, of a clip on a body (22, 3), in a space."""
    local = axis_angle_to_matrix(torch.tensor(clip.poses))
    joints = torch.tensor(rest)
    rotations, positions = forward_kinematics(local, torch.tensor(clip.trans) + joints[0], joints)
    tracked = list(TRACKED)
    turned = space.convert_rotations_from_amass(rotations[:, tracked].numpy())
    quaternions = matrix_to_quaternion(turned.reshape(-1, 3, 3)).reshape(-1, 3, 4)
    return np.concatenate(
        [space.convert_positions_from_amass(positions[:, tracked].numpy()), quaternions], -1
    )


def write(path: Path, frames: np.ndarray) -> None:
    """Write trackers (N, 3, 7) as CSV."""
    parts = ("x", "y", "z", "qx", "qy", "qz", "qw")
    header = ",".join(f"{name}.{part}" for name in ("head", "left", "right") for part in parts)
    np.savetxt(path, frames.reshape(len(frames), -1), "%.9g", ",", header=header, comments="")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(description="A clip's head and hands at 60 Hz, as CSV.")
    made.add_argument("clip", type=Path, help="an npz file of AMASS' format")
    made.add_argument("--space", choices=[*SPACES], default="amass", help="as of memmlp export")
    made.add_argument("--body", default="builtin", help="builtin, or an SMPL-H model.npz")
    made.add_argument("--out", type=Path, required=True, help="the CSV file to write")
    return made


def main() -> None:
    """Write the trackers of one clip."""
    asked = parser().parse_args()
    clip, _ = resample(read_clip(asked.clip, asked.clip.stem))
    write(asked.out, trackers(clip, load_rest_joints(asked.body), SPACES[asked.space]))


if __name__ == "__main__":
    main()
