"""Rotations and forward kinematics on NumPy arrays, one frame at a time. Quaternions are x, y, z, w.
`memmlp.motion.geometry` has the same functions for torch tensors, which a live stream does not import."""

import numpy as np

from memmlp.motion.body import N_JOINTS, PARENTS, TRACKED

# Let q be the outer product of a quaternion (x, y, z, w) with itself, flattened to (16,). The rotation matrix
# m, flattened to (9,), is linear in it: m = q @ _MATRIX, and back q = (m @ _MATRIX.T + identity) / 4. So a
# conversion is a single product, which is quick for one frame.
_MATRIX: np.ndarray = np.zeros((4, 4, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _MATRIX[_i, _i, [0, 1, 2], [0, 1, 2]] = -1
    _MATRIX[_i, _i, _i, _i] = 1
    _MATRIX[3, 3, _i, _i] = 1
    _MATRIX[[_i, _j], [_j, _i], _i, _j] = _MATRIX[[_i, _j], [_j, _i], _j, _i] = 1
    _MATRIX[[_k, 3], [3, _k], _i, _j], _MATRIX[[_k, 3], [3, _k], _j, _i] = -1, 1
_MATRIX = _MATRIX.reshape(16, 9)
_IDENTITY = np.eye(4).reshape(16)


def quaternion_to_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Convert unit quaternions (..., 4), xyzw, to matrices (..., 3, 3)."""
    outer = quaternion[..., :, None] * quaternion[..., None, :]
    return (outer.reshape(*quaternion.shape[:-1], 16) @ _MATRIX).reshape(*quaternion.shape[:-1], 3, 3)


def matrix_to_quaternion(matrix: np.ndarray) -> np.ndarray:
    """Convert matrices (n, 3, 3) to unit quaternions (n, 4), xyzw, w not negative; accurate at every angle.
    Each row of the quaternion's outer product with itself is the quaternion, scaled by one component. The row
    of the largest component is well conditioned."""
    outer = (matrix.reshape(-1, 9) @ _MATRIX.T + _IDENTITY).reshape(-1, 4, 4)
    pivot = np.einsum("nii->ni", outer).argmax(1)
    quaternion = outer[np.arange(len(outer)), pivot]
    quaternion /= np.sqrt(np.einsum("ni,ni->n", quaternion, quaternion))[:, None]
    quaternion[quaternion[:, 3] < 0] *= -1
    return quaternion


def rotate_by_fraction(matrix: np.ndarray, fraction: np.ndarray | float) -> np.ndarray:
    """Multiply the angle (0 to pi) of each rotation (n, 3, 3) by `fraction`, () or (n,); keep the axis."""
    quaternion = matrix_to_quaternion(matrix)
    vector, w = quaternion[:, :3], quaternion[:, 3]
    sine = np.sqrt(np.einsum("ni,ni->n", vector, vector))
    half = fraction * np.arctan2(sine, w)
    scale = np.where(sine > 1e-9, np.sin(half) / np.maximum(sine, 1e-9), fraction)
    return quaternion_to_matrix(np.concatenate([vector * scale[:, None], np.cos(half)[:, None]], 1))


def slerp(a: np.ndarray, b: np.ndarray, weight: float) -> np.ndarray:
    """Interpolate between rotations (n, 3, 3) along the shortest path from a (weight 0) to b (weight 1).
    Weights above 1 extrapolate."""
    return a @ rotate_by_fraction(a.swapaxes(-1, -2) @ b, weight)


def sixd_to_matrix(sixd: np.ndarray) -> np.ndarray:
    """Convert (n, 6) to matrices (n, 3, 3) by Gram-Schmidt, like `memmlp.motion.geometry.sixd_to_matrix`."""
    columns = np.empty((3, 5, len(sixd)), sixd.dtype)  # x y z x y, so that a cross product takes slices
    columns[:2, :3] = sixd.T.reshape(2, 3, -1)
    first, second = columns[:2, :3]
    first /= np.sqrt(np.add.reduce(first * first, 0))
    second -= np.add.reduce(first * second, 0) * first
    second /= np.sqrt(np.add.reduce(second * second, 0))
    columns[:2, 3:] = columns[:2, :2]
    a, b, third = columns
    third[:3] = a[1:4] * b[2:5] - a[2:5] * b[1:4]
    return columns[:, :3].transpose(2, 1, 0)


class BodyTree:
    """A body with rest joints (22, 3), metres, SMPL's body frame, for forward kinematics of one frame.

    The computation doubles the chain of transforms in each step. Step k multiplies the transform of each
    joint by the transform of the ancestor 2^k levels above. So a tree of depth 8 needs three batched products
    instead of eight.

    Attributes:
        tracked: the indices of head, left and right wrist.
        bone_offsets: (22, 3), metres, from the parent to the joint; 0 for the root.
        ancestors: an array per step k with the index of the ancestor 2^k levels above each joint (23). The
            last entry is an extra joint above the root, with the identity transform.
    """

    def __init__(self, rest: np.ndarray):
        self.rest, self.tracked = rest, list(TRACKED)
        parent = np.array([N_JOINTS, *PARENTS[1:], N_JOINTS])  # the extra joint is its own parent
        self.ancestors = [parent]
        while (self.ancestors[-1] != N_JOINTS).any():
            self.ancestors.append(self.ancestors[-1][self.ancestors[-1]])
        self.ancestors.pop()
        self.bone_offsets = np.zeros((N_JOINTS, 3))
        self.bone_offsets[1:] = rest[1:] - rest[parent[1:N_JOINTS]]
        self._transforms = np.tile(np.eye(4, dtype=np.float32), (N_JOINTS + 1, 1, 1))
        self._transforms[:-1, :3, 3] = self.bone_offsets

    def compute_positions(self, local: np.ndarray) -> np.ndarray:
        """Return the joint positions (22, 3), metres, relative to the head, for local rotations (22, 3, 3);
        the root's is global."""
        transforms = self._transforms
        transforms[:-1, :3, :3] = local
        for ancestor in self.ancestors:
            transforms = transforms.take(ancestor, 0) @ transforms
        return transforms[:-1, :3, 3] - transforms[self.tracked[0], :3, 3]
