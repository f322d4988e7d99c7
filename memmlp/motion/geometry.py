"""Rotations, forward kinematics, and the motion frames [X | Theta], with torch tensors.

Rotations may have any leading shape and floating type. A rotation matrix acts on column vectors. "6D" is the
matrix's first column followed by its second column (Zhou et al. 2019). Angles are in radians.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from memmlp.motion.body import HEAD, N_JOINTS, PARENTS, TRACKED

if TYPE_CHECKING:
    from memmlp.motion.clip import Clip


def axis_angle_to_matrix(axis_angle: Tensor) -> Tensor:
    """Convert axis-angle (..., 3) to matrices (..., 3, 3) by Rodrigues' formula; smooth through angle 0."""
    square = (axis_angle * axis_angle).sum(-1, keepdim=True)
    small = square < 1e-8
    angle = torch.where(small, torch.ones_like(square), square).sqrt()
    sine = torch.where(small, 1 - square / 6, angle.sin() / angle)[..., None]
    cosine = torch.where(small, 0.5 - square / 24, (1 - angle.cos()) / angle.square())[..., None]
    x, y, z = axis_angle.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return identity + sine * cross + cosine * (cross @ cross)


def matrix_to_wxyz(matrix: Tensor) -> Tensor:
    """Convert matrices (..., 3, 3) to unit quaternions (..., 4) in the order wxyz, with w >= 0."""
    forms = _make_quaternion_forms(matrix)
    # Four scaled forms of the same quaternion; the form with the largest pivot is well conditioned.
    pivot = forms.diagonal(dim1=-2, dim2=-1).argmax(-1)
    return _choose_quaternion(forms, pivot)


def _make_quaternion_forms(m: Tensor) -> Tensor:
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    ww, xx, yy, zz = 1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz
    rows = [ww, wx, wy, wz], [wx, xx, xy, xz], [wy, xy, yy, yz], [wz, xz, yz, zz]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _choose_quaternion(forms: Tensor, pivot: Tensor) -> Tensor:
    index = pivot[..., None, None].expand(*pivot.shape, 1, 4)
    quaternion = F.normalize(forms.gather(-2, index).squeeze(-2), dim=-1)
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def matrix_to_axis_angle(matrix: Tensor) -> Tensor:
    """Convert matrices (..., 3, 3) to axis-angle (..., 3) of norm at most pi. It is accurate at 0 and near
    pi, because it goes through a quaternion."""
    quaternion = matrix_to_wxyz(matrix)
    vector = quaternion[..., 1:]
    sine = vector.norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, quaternion[..., :1])
    scale = torch.where(sine < 1e-7, torch.full_like(sine, 2.0), angle / sine.clamp_min(1e-7))
    return vector * scale


def matrix_to_sixd(matrix: Tensor) -> Tensor:
    """Convert matrices (..., 3, 3) to 6D (..., 6): the first column, then the second."""
    return torch.cat([matrix[..., :, 0], matrix[..., :, 1]], -1)


def sixd_to_matrix(sixd: Tensor) -> Tensor:
    """Convert 6D (..., 6) to matrices (..., 3, 3) by Gram-Schmidt. Any two columns that are not zero and not
    parallel give a rotation. Each component is a tensor of its own, which is fast for many rotations."""
    a, b, c, d, e, f = sixd.movedim(-1, 0).contiguous().unbind()
    a, b, c = _normalize(a, b, c)
    along = a * d + b * e + c * f
    d, e, f = _normalize(d - along * a, e - along * b, f - along * c)
    columns = [a, b, c, d, e, f, b * f - c * e, c * d - a * f, a * e - b * d]
    return torch.stack(columns).unflatten(0, (3, 3)).movedim((1, 0), (-2, -1)).contiguous()


def _normalize(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    square = torch.addcmul(torch.addcmul(x * x, y, y), z, z)
    size = square.clamp_min(1e-24).sqrt()  # 1e-12 at least, as in F.normalize
    return x / size, y / size, z / size


def complete_columns(sixd: Tensor) -> Tensor:
    """Return 6D (..., 6) and its columns' cross product as matrices (..., 3, 3), which are rotations only if
    the columns are orthonormal. See `sixd_to_matrix`."""
    first, second = sixd[..., :3], sixd[..., 3:]
    return torch.stack([first, second, torch.linalg.cross(first, second, dim=-1)], -1)


def convert_almost_rotations(matrix: Tensor) -> Tensor:
    """Convert matrices (..., 3, 3) that are almost rotations to rotations (..., 3, 3), through the quaternion
    that human_body_prior reads from them. It chooses the quaternion's form by signs of the diagonal."""
    xx, yy, zz = matrix.diagonal(dim1=-2, dim2=-1).unbind(-1)
    # the forms' pivots, in this order: w, x, y, z
    flat = torch.where(xx > yy, 1, 2)
    pivot = torch.where(zz < 1e-6, flat, torch.where(xx < -yy, 3, 0))
    w, x, y, z = _choose_quaternion(_make_quaternion_forms(matrix), pivot).unbind(-1)
    rows = (
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def compute_geodesic_angle(a: Tensor, b: Tensor) -> Tensor:
    """Return the angle (...) in [0, pi] between rotations (..., 3, 3); accurate at 0 and at pi."""
    relative = (a.transpose(-1, -2) @ b).flatten(-2)
    xx, xy, xz, yx, yy, yz, zx, zy, zz = relative.unbind(-1)
    skew = torch.stack([zy - yz, xz - zx, yx - xy], -1)
    return torch.atan2(skew.norm(dim=-1), xx + yy + zz - 1)


def forward_kinematics(local: Tensor, root: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Return the joints' global rotations (..., 22, 3, 3) and positions (..., 22, 3), metres, world, for
    local rotations (..., 22, 3, 3), of which the root's is global, and the root's position (..., 3). Of
    `rest` (22, 3), only the offsets between joint and parent matter. Joints at the same depth of the tree are
    computed together, which is fast."""
    offsets = (rest - rest[list(PARENTS)])[..., None]  # the root's offset is not used
    top, *levels = local.split([1, *(joints.stop - joints.start for joints, _ in LEVELS)], -3)
    rotations, positions = [top], [root[..., None, :, None]]
    for level, (joints, parents) in zip(levels, LEVELS, strict=True):
        above = _take_rows(rotations[-1], parents)
        positions.append(_take_rows(positions[-1], parents) + above @ offsets[joints])
        rotations.append(above @ level)
    return torch.cat(rotations, -3), torch.cat(positions, -3)[..., 0]


def build_bone_chains() -> Tensor:
    """Build the matrix (22, 21) that sums rotated bones to joint positions relative to the head. Each joint
    except the root has a bone, which leads from its parent to the joint."""
    chains = torch.zeros(N_JOINTS, N_JOINTS - 1)
    for joint in range(1, N_JOINTS):
        chains[joint] = chains[PARENTS[joint]]
        chains[joint, joint - 1] = 1
    return chains - chains[HEAD]


def _take_rows(values: Tensor, runs: list[slice]) -> Tensor:
    """Return the rows of values (..., n, a, b) within several slices, concatenated."""
    if runs == [slice(0, values.shape[-3])]:
        return values
    parts = [values[..., run, :, :] for run in runs]
    return parts[0] if len(parts) == 1 else torch.cat(parts, -3)


LEVELS: tuple[tuple[slice, list[slice]], ...] = (
    (slice(1, 4), [slice(0, 1)] * 3),  # hips and first spine joint on the pelvis
    (slice(4, 7), [slice(0, 3)]),
    (slice(7, 10), [slice(0, 3)]),
    (slice(10, 15), [slice(0, 3), slice(2, 3), slice(2, 3)]),  # toes; neck, collars on the last spine joint
    (slice(15, 18), [slice(2, 5)]),
    (slice(18, 20), [slice(1, 3)]),
    (slice(20, 22), [slice(0, 2)]),
)
"""For each depth of the tree: its joints, and their parents as slices of the previous depth's joints."""


def compute_clip_kinematics(clip: Clip, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute a clip's global rotations (N, 22, 3, 3) and positions (N, 22, 3), metres, world, on a body with
    rest joints (22, 3), metres."""
    local = axis_angle_to_matrix(torch.from_numpy(clip.poses))
    joints = torch.from_numpy(rest)
    rotations, positions = forward_kinematics(local, joints[0] + torch.from_numpy(clip.trans), joints)
    return rotations.numpy(), positions.numpy()


def compute_sparse_features(rotations: Tensor, positions: Tensor) -> Tensor:
    """Compute the network inputs X (N - 1, 54) from three trackers (AvatarPoser's features, Sec. 3.1 of the
    paper): global rotations (N, 3, 3, 3) and positions (N, 3, 3), metres, of head, left and right wrist.
    `memmlp.motion.body.SPARSE_*` has the layout. Frame 0 has no velocity and is dropped."""
    angular = rotations[:-1].transpose(-1, -2) @ rotations[1:]
    sixd, angular_sixd = matrix_to_sixd(rotations[1:]), matrix_to_sixd(angular)
    parts = (sixd, angular_sixd, positions[1:], positions[1:] - positions[:-1])
    return torch.cat([part.flatten(1) for part in parts], 1)


def compute_motion_frames(poses: Tensor, trans: Tensor, rest: Tensor) -> Tensor:
    """Compute a clip's frames [X | Theta] (N - 1, 252), world, from axis-angle poses (N, 22, 3), translation
    (N, 3), metres, and rest positions (22, 3), metres; see `Clip`."""
    local = axis_angle_to_matrix(poses)
    rotations, positions = forward_kinematics(local, trans + rest[0], rest)
    tracked = list(TRACKED)
    sparse = compute_sparse_features(rotations[:, tracked], positions[:, tracked])
    theta = torch.cat([matrix_to_sixd(local).flatten(1), positions.flatten(1)], 1)
    return torch.cat([sparse, theta[1:]], 1)


@contextmanager
def limit_to_one_thread() -> Iterator[None]:
    """Limit torch to one thread within the context: for short clips, more threads are slower."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
