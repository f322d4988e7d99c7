"""The example that prints bones reads the VMC packets of python-osc."""

import re
import socket
import subprocess
import sys

import numpy as np
import pytest
from examples.conftest import EXAMPLES
from processes import started
from scipy.spatial.transform import Rotation

builder = pytest.importorskip("pythonosc.osc_bundle_builder")
message = pytest.importorskip("pythonosc.osc_message_builder")

PARENTS = {  # a body without an upper chest and without toes
    "root": None, "Hips": "root", "Spine": "Hips", "Chest": "Spine", "Neck": "Chest", "Head": "Neck",
    "LeftShoulder": "Chest", "LeftUpperArm": "LeftShoulder", "LeftLowerArm": "LeftUpperArm",
    "LeftHand": "LeftLowerArm", "RightShoulder": "Chest", "RightUpperArm": "RightShoulder",
    "RightLowerArm": "RightUpperArm", "RightHand": "RightLowerArm", "LeftUpperLeg": "Hips",
    "LeftLowerLeg": "LeftUpperLeg", "LeftFoot": "LeftLowerLeg", "RightUpperLeg": "Hips",
    "RightLowerLeg": "RightUpperLeg", "RightFoot": "RightLowerLeg",
}  # fmt: skip
FRAMES = 4


def packet(name: str, values: np.ndarray) -> bytes:
    """A message of the specification, in a bundle within a bundle."""
    made = message.OscMessageBuilder(f"/VMC/Ext/{'Root' if name == 'root' else 'Bone'}/Pos")
    made.add_arg(name)
    for value in values:
        made.add_arg(float(value), "f")
    inner, outer = (builder.OscBundleBuilder(builder.IMMEDIATELY) for _ in range(2))
    time = message.OscMessageBuilder("/VMC/Ext/T")
    time.add_arg(1.5, "f")
    inner.add_content(time.build())
    inner.add_content(made.build())
    outer.add_content(inner.build())
    return outer.build().dgram


@pytest.mark.slow
def test_it_prints_where_bones_are():
    random = np.random.default_rng(0)
    frames = random.normal(size=(FRAMES + 1, len(PARENTS), 7))
    frames[..., 3:] /= np.linalg.norm(frames[..., 3:], axis=-1, keepdims=True)
    receive = [str(EXAMPLES / "vmc/receive.py"), "--port", "0", "--frames", str(FRAMES), "--all"]
    with (
        started(
            [sys.executable, *receive], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        port = int(re.search(r"\d+", process.stderr.readline())[0])
        for frame in frames:  # the last is what ends the one before it
            for name, values in zip(PARENTS, frame, strict=True):
                sender.sendto(packet(name, values), ("127.0.0.1", port))
        said, wrong = process.communicate(timeout=60)
    assert (process.returncode, wrong) == (0, "")
    lines = said.splitlines()
    assert len(lines) == FRAMES
    for line, frame in zip(lines, frames, strict=False):
        found = {name: np.array(at, float) for name, *at in (bone.split() for bone in line.split("  "))}
        true = by_matrices(frame)
        assert set(found) == set(PARENTS)
        for name, position in found.items():
            np.testing.assert_allclose(position, true[name], atol=1e-3)


def by_matrices(frame: np.ndarray) -> dict[str, np.ndarray]:
    world: dict[str | None, np.ndarray] = {None: np.eye(4)}
    for (name, parent), values in zip(PARENTS.items(), frame, strict=True):
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
        world[name] = world[parent] @ local
    return {name: matrix[:3, 3] for name, matrix in world.items()}
