"""A whole body from head and hands, with only NumPy and ONNX Runtime.

    python full_body.py body.onnx trackers.csv > joints.csv
    python full_body.py body.onnx trackers.csv --save motion.npz

`memmlp export RUN --scope full --space SPACE --out body.onnx` writes `body.onnx`. `trackers.csv` has a header
and one row for each frame at 60 Hz: x, y, z in metres and a quaternion qx, qy, qz, qw of head, left and right
wrist, in SPACE. The output is the 22 joints of each frame, metres, in SPACE.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime

STATE, NEXT = "state.", ".next"


class FullBody:
    """The network with its memory: one step for each frame at 60 Hz.

    Attributes:
        joints, parents: names of the joints and indices of their parents, -1 for the root.
        rest: the T-pose (22, 3), metres, in SMPL's axes (Y up, facing +Z, left is +X), whatever the space.
        space, fps: the frame of reference of inputs and outputs; frames per second.
    """

    def __init__(self, path: Path):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # faster than more threads for a small network
        self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        about = self.session.get_modelmeta().custom_metadata_map
        if about.get("scope") != "full":
            sys.exit(f"{path}: not written by memmlp export with --scope full")
        self.joints, self.parents = json.loads(about["joints"]), json.loads(about["parents"])
        self.rest = np.array(json.loads(about["rest"]))
        self.space, self.fps = about["space"], float(about["fps"])
        self.outputs = [output.name for output in self.session.get_outputs()]
        self.reset()

    def reset(self) -> None:
        """Forget the past: a fresh start is zeros."""
        inputs = self.session.get_inputs()
        self.state = {i.name: np.zeros(i.shape, np.float32) for i in inputs if i.name.startswith(STATE)}

    def step(self, positions: np.ndarray, rotations: np.ndarray) -> dict[str, np.ndarray]:
        """Take one frame of head, left and right: positions (3, 3), metres, and matrices (3, 3, 3).

        Returns rotations (22, 3, 3), each relative to its parent's and the root's global, or quaternions
        (22, 4) if the file was exported with them; positions (22, 3), metres, by forward kinematics; joints
        (22, 3), metres, the network's own guess of the positions.
        """
        trackers = {"tracker_positions": positions[None], "tracker_rotations": rotations[None]}
        given = {name: value.astype(np.float32) for name, value in trackers.items()} | self.state
        made = dict(zip(self.outputs, self.session.run(None, given), strict=True))
        self.state = {name: made.pop(name + NEXT) for name in self.state}
        return {name: value[0] for name, value in made.items()}


def matrices(quaternions: np.ndarray) -> np.ndarray:
    """Convert unit quaternions (..., 4), x y z w, to matrices (..., 3, 3)."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def read_trackers(path: Path) -> np.ndarray:
    """Read trackers (N, 3, 7): head, left, right; x y z, qx qy qz qw.

    A frame with a lost tracker is rejected: NaN would stay in the network's memory forever.
    """
    rows = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    if rows.shape[1] != 21:
        sys.exit(f"{path}: rows of {rows.shape[1]} numbers; expected 21")
    trackers = rows.reshape(-1, 3, 7)
    wrong = ~(np.abs(np.linalg.norm(trackers[..., 3:], axis=-1) - 1) < 1e-2) | ~np.isfinite(trackers).all(-1)
    if wrong.any():
        sys.exit(f"{path}: line {2 + wrong.any(1).argmax()}: not three metres and a unit quaternion")
    return trackers


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(description="A whole body from head and hands, from one ONNX file.")
    made.add_argument("network", type=Path, help="what memmlp export --scope full wrote")
    made.add_argument("trackers", type=Path, help="head, left and right at 60 Hz, a CSV file")
    made.add_argument("--save", type=Path, help="the whole motion as an npz file, for Blender's example")
    return made


def main() -> None:
    """Write the joints of each frame."""
    asked = parser().parse_args()
    trackers, body = read_trackers(asked.trackers), FullBody(asked.network)
    made = [body.step(frame[:, :3], matrices(frame[:, 3:])) for frame in trackers]
    motion = {name: np.stack([frame[name] for frame in made]) for name in made[0]}
    if asked.save:
        about = {
            name: np.array(getattr(body, name)) for name in ("joints", "parents", "rest", "space", "fps")
        }
        np.savez(asked.save, rotations=motion["rotations"], positions=motion["positions"], **about)
    else:
        header = ",".join(f"{joint}.{axis}" for joint in body.joints for axis in "xyz")
        np.savetxt(
            sys.stdout, motion["positions"].reshape(len(made), -1), "%.6f", ",", header=header, comments=""
        )


if __name__ == "__main__":
    main()
