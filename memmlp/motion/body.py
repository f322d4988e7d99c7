"""The conventions of all motion data: body joints, joint tree, feature layout and frames of reference.

Frames of reference: motion lives in AMASS' world (Z up, metres). A rest pose lives in SMPL's body frame (Y
up, the person faces +Z, left is +X, T-pose). The root's rotation turns it into the world. A
body joint's rotation is local, relative to its parent; the root's is global."""

import json
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import digest

FPS = 60  # frames per second of all motion after `memmlp.motion.clip.resample`

JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
N_JOINTS = len(JOINTS)
CHILDREN = tuple([child for child, parent in enumerate(PARENTS) if parent == j] for j in range(N_JOINTS))

ROOT, HEAD, LEFT_WRIST, RIGHT_WRIST = 0, 15, 20, 21
TRACKED = (HEAD, LEFT_WRIST, RIGHT_WRIST)  # the three sensors, in the order of the input
HANDS = (LEFT_WRIST, RIGHT_WRIST)
LOWER = (0, 1, 2, 4, 5, 7, 8, 10, 11)  # AGRoL and SAGE count the root as lower body
UPPER = (3, 6, 9, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21)

# One frame of input, X (54): AvatarPoser's and AGRoL's order, feature-major over TRACKED.
SPARSE_DIM = 54
SPARSE_ROTATION = slice(0, 18)  # global rotation, 6D x 3
SPARSE_ANGULAR_VELOCITY = slice(18, 36)  # R[t-1]^-1 R[t], 6D x 3
SPARSE_POSITION = slice(36, 45)  # global position, metres
SPARSE_VELOCITY = slice(45, 54)  # p[t] - p[t-1], metres per frame
FEATURES = (
    "joints head, left_wrist, right_wrist; 0:18 global rotation 6D, 18:36 R[t-1]^-1 R[t] 6D, "
    "36:45 global position m, 45:54 p[t]-p[t-1] m/frame; 6D = first two columns; world Z up"
)

# One frame of motion, Theta (198).
MOTION_DIM = 198
ROTATION = slice(0, 132)  # local rotations of the 22 joints, 6D
POSITION = slice(132, 198)  # global positions of the 22 joints, metres

# One frame of a prepared cache: X, then Theta.
FRAME_DIM = SPARSE_DIM + MOTION_DIM

# An adult of 1.72 m in T-pose; only the left side is listed, the right one is its mirror image. Segment
# lengths follow the usual anthropometric fractions of stature (Drillis & Contini 1966, in Winter,
# "Biomechanics and Motor Control of Human Movement"); shoulders and hips are at the joint centres. The
# pelvis is the origin.
_REST = {
    "pelvis": (0.0, 0.0, 0.0),
    "left_hip": (0.085, -0.085, -0.005),
    "spine1": (0.0, 0.105, -0.015),
    "left_knee": (0.095, -0.505, 0.005),
    "spine2": (0.0, 0.235, -0.020),
    "left_ankle": (0.095, -0.925, -0.025),
    "spine3": (0.0, 0.290, -0.005),
    "left_foot": (0.115, -0.980, 0.095),
    "neck": (0.0, 0.500, -0.030),
    "left_collar": (0.080, 0.405, -0.025),
    "head": (0.0, 0.590, 0.010),
    "left_shoulder": (0.180, 0.435, -0.040),
    "left_elbow": (0.455, 0.430, -0.055),
    "left_wrist": (0.710, 0.430, -0.055),
}


def make_builtin_rest_joints() -> np.ndarray:
    """Return the rest positions (22, 3) of the built-in adult: metres, SMPL's body frame, pelvis at 0."""
    joints = np.array([_REST[name.replace("right_", "left_")] for name in JOINTS])
    joints[[name.startswith("right_") for name in JOINTS], 0] *= -1
    return joints


def load_rest_joints(body: str | Path) -> np.ndarray:
    """Load the rest positions (22, 3), metres, of a body with zero betas: "builtin", or an SMPL-H
    `model.npz`, of which only `J_regressor @ v_template` is computed. Raises InputError if the file is not an
    SMPL-H model."""
    if str(body) == "builtin":
        return make_builtin_rest_joints()
    path = Path(body).expanduser()
    if not path.is_file():
        raise InputError(f"data.body={path}: no such file; must be builtin, or an SMPL-H model.npz")
    try:
        with np.load(path, allow_pickle=False) as model:
            joints = np.asarray(model["J_regressor"] @ model["v_template"], dtype=np.float64)
            parents = np.asarray(model["kintree_table"])[0, :N_JOINTS].astype(np.int64)
    except (OSError, ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"data.body={path}: not an SMPL-H model.npz ({error})") from error
    if joints.ndim != 2 or joints.shape[0] < N_JOINTS or joints.shape[1] != 3:
        raise InputError(f"data.body={path}: joints of shape {joints.shape}; must be (22 or more, 3)")
    if not np.isfinite(joints).all() or tuple(parents[1:]) != PARENTS[1:]:
        raise InputError(f"data.body={path}: must have SMPL's tree of 22 body joints")
    return joints[:N_JOINTS]


_SIDES = {"left": "right", "right": "left"}
SWAPPED = tuple(JOINTS.index("_".join(_SIDES.get(word, word) for word in name.split("_"))) for name in JOINTS)
"""The index of each joint's mirrored joint: left and right are exchanged."""


# Imported clips can be used only with the body of their import: their height above the floor depends on it

RECORD = "import.json"  # the record file that an import writes into its folder


def describe_body(body: str, rest: np.ndarray) -> dict[str, Any]:
    """Return a body's entries in an import record: its name and its rest joints (22, 3), metres."""
    return {"body": Path(body).name, "joints": rest.round(6).tolist()}


def format_body_name(body: str, rest: np.ndarray) -> str:
    """Return a body's name. A model's name includes a digest of its rest joints (22, 3), because all model
    files have the same name."""
    return "builtin" if body == "builtin" else f"{Path(body).name} {digest(rest.tolist())[:8]}"


def check_imported_body(clips: Iterable[Path], rest: np.ndarray, body_source: str) -> None:
    """Check that imported clips are used with the body of their import, given its rest joints (22, 3),
    metres: the floor height differs by centimetres between bodies. Clips without an import record pass.
    `body_source` is the setting, option or network that selected the body. Raises InputError if the clips
    were imported for a different body."""
    folders = {clip.parent.resolve() for clip in clips}
    above = ([parent / RECORD for parent in (folder, *folder.parents)] for folder in folders)
    for path in sorted({path for paths in above if (path := next(filter(Path.is_file, paths), None))}):
        try:
            record = json.loads(path.read_text("utf-8"))
            body, joints = record["body"], np.asarray(record["joints"], np.float64)
        except (OSError, ValueError, TypeError, KeyError):
            continue  # written by another program
        # Networks have their joints in float32.
        if joints.shape != rest.shape or not np.allclose(joints, rest, rtol=0, atol=1e-4):
            wrong = f"the clips were imported for the body {body}, but {body_source} is different"
            advice = "use the same body, or import the clips again with --body"
            raise InputError(f"{path.parent}: {wrong}; {advice}")


_RADII = {
    "pelvis": 0.100, "hip": 0.082, "knee": 0.054, "ankle": 0.038, "foot": 0.030, "spine1": 0.100,
    "spine2": 0.106, "spine3": 0.108, "neck": 0.050, "collar": 0.062, "head": 0.052, "shoulder": 0.054,
    "elbow": 0.041, "wrist": 0.031,
}  # fmt: skip
RADII = tuple(_RADII[name.split("_")[-1]] for name in JOINTS)  # the body's radius at each joint, metres

HEAT = ("#2b5fd9", "#27a9e1", "#3fc380", "#f2d43d", "#f28c28", "#c4161c")
"""The colour scale for joint errors, from zero to the maximum, evenly spaced."""


class Limb(NamedTuple):
    """A round limb from one joint to another; `radii` are those at its ends, metres. If `tip` is not 0, the
    limb begins at `end`, and extends by this length, metres, in the direction from `start` to `end`."""

    start: int
    end: int
    radii: tuple[float, float]
    tip: float = 0.0

    @property
    def first_joint(self) -> int:
        return self.end if self.tip else self.start


LIMBS = (
    *(Limb(p, j, (RADII[p], RADII[j])) for j, p in enumerate(PARENTS) if p >= 0),
    Limb(PARENTS[HEAD], HEAD, (0.085, 0.095), 0.085),
    *(Limb(PARENTS[hand], hand, (0.031, 0.038), 0.085) for hand in (LEFT_WRIST, RIGHT_WRIST)),
)


def find_limb_ends(limb: Limb, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of a limb's two ends, each (3,), metres, for the joint positions (22, 3)."""
    start, end = joints[limb.start], joints[limb.end]
    if not limb.tip:
        return start, end
    along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)
    return end, end + limb.tip * along
