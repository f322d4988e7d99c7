"""The check of an import: compares the written clip with the BVH file that it came from."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from memmlp.common.progress import progress_bar
from memmlp.motion.body import JOINTS, load_rest_joints
from memmlp.motion.formats.bvh import find_bvh, read_bvh
from memmlp.motion.formats.npz import read_clip, write_clip
from memmlp.motion.geometry import axis_angle_to_matrix, forward_kinematics
from memmlp.motion.importing.retarget import fit, limb_angles, retarget
from memmlp.motion.importing.skeleton import LIMBS, Z_UP, find_skeleton, load_skeleton


@dataclass(frozen=True)
class Fidelity:
    """How far an import is from its source, in the worst frame.

    Attributes:
        name: the file's path below the source folder.
        skeleton: name of the skeleton map.
        frames: number of frames compared.
        worst_mm: largest distance, in millimetres, between a mapped joint in the file and in the import posed
            on the source's own bones.
        worst_joint: the body joint where that is.
        worst_degrees: largest angle between a limb (upper arm, forearm, thigh, shin) in the file and on the
            body.
    """

    name: str
    skeleton: str
    frames: int
    worst_mm: float
    worst_joint: str
    worst_degrees: float


def verify(path: Path, *, skeleton: str | None = None, body: str = "builtin", name: str = "") -> Fidelity:
    """Import one file to an npz, read it back, and compare it with the file's own kinematics.

    The file's side uses `Bvh.kinematics` alone, the other side the npz and `geometry.forward_kinematics`
    alone. A joint below an unmapped source joint that turns has no bone of constant length: the distance then
    shows it.

    Args:
        path: the BVH file.
        skeleton: a shipped map or the path of one; by default the file's joints decide.
        body: "builtin", or an SMPL-H model.npz.
        name: the name to report; by default the file's.

    Raises:
        InputError: if the file is damaged or fits no map.
    """
    bvh, rest = read_bvh(path), load_rest_joints(body)
    chosen = load_skeleton(skeleton) if skeleton else find_skeleton(bvh)
    with tempfile.TemporaryDirectory() as folder:
        write_clip(Path(folder) / "clip.npz", retarget(bvh, chosen, rest))
        clip = read_clip(Path(folder) / "clip.npz", name)
    fitted = fit(bvh, chosen, rest)
    nodes = bvh.kinematics()[1][int(chosen.calibration_frame) :, fitted.nodes]
    expected = chosen.unit * nodes @ (Z_UP @ chosen.upright).T
    local = axis_angle_to_matrix(torch.from_numpy(clip.poses))
    root = torch.from_numpy(rest[0] + clip.trans)
    own_root = (root - local[:, 0] @ torch.from_numpy(fitted.anchor)) / fitted.scale
    own = forward_kinematics(local, own_root, torch.from_numpy(fitted.own_rest))[1].numpy()
    distance = np.linalg.norm(own - expected, axis=-1).max(0)
    bodily = forward_kinematics(local, root, torch.from_numpy(rest))[1].numpy()
    start, end = list(LIMBS), list(LIMBS.values())
    angles = limb_angles(bodily[:, end] - bodily[:, start], expected[:, end] - expected[:, start])
    return Fidelity(
        name=name or path.name,
        skeleton=chosen.name,
        frames=len(clip),
        worst_mm=1000 * float(distance.max()),
        worst_joint=JOINTS[int(distance.argmax())],
        worst_degrees=math.degrees(float(angles.max())),
    )


def verify_folder(source: Path, *, skeleton: str | None = None, body: str = "builtin") -> list[Fidelity]:
    """Verify each BVH file of a folder, or a single one.

    Raises:
        InputError: at the first bad file.
    """
    files = find_bvh(source)
    return [
        verify(path, skeleton=skeleton, body=body, name=relative.as_posix())
        for relative, path in progress_bar(files.items(), "verify", len(files))
    ]
