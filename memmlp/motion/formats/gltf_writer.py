"""Writes clips as glTF 2.0 (.glb): 22 nodes with an animation, and a mannequin that is skinned to them.

The world is glTF's: right-handed, Y up, metres, seconds. In the bind pose the person stands in T-pose on the
floor and faces +Z; a node has its joint's name, its rotation is the joint's local rotation, and only the
root is translated. JSON and buffers are written as in the specification (Khronos Group, glTF 2.0.1).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import memmlp
from memmlp.common.files import atomic_file
from memmlp.motion.body import JOINTS, N_JOINTS, PARENTS
from memmlp.motion.clip import Clip
from memmlp.motion.formats.y_up import y_up_motion
from memmlp.motion.limb_shapes import LIMBS, ends

COMPONENTS = {"<f4": 5126, "<u2": 5123, "|u1": 5121}  # glTF's numbers for types of components
VERTICES, INDICES = 34962, 34963  # what a buffer view is for
COLOUR = (0.38, 0.44, 0.50, 1.0)  # of the mannequin, linear RGB and opacity
AROUND, CAP = 16, 4  # vertices around a limb; rings of the half sphere at each of its ends


def write_gltf(path: Path, clip: Clip, rest: np.ndarray) -> None:
    """Write a clip on a body with these rest joints (22, 3), metres, as a .glb file, atomically."""
    buffer = Buffer()
    bind = rest - [0, rest[:, 1].min(), 0]  # the lowest joint on the floor
    content = {
        "asset": {"version": "2.0", "generator": f"memmlp {memmlp.__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0, N_JOINTS]}],
        "nodes": [*joint_nodes(bind), {"name": "mannequin", "mesh": 0, "skin": 0}],
        "skins": [skin(buffer, bind)],
        "meshes": [{"name": "mannequin", "primitives": [primitive(buffer, mannequin(bind))]}],
        "materials": [{"name": "mannequin", "pbrMetallicRoughness": _MATERIAL}],
        "animations": [_animation(buffer, clip, rest)],
    }
    write_glb(path, content, buffer)


_MATERIAL = {"baseColorFactor": COLOUR, "metallicFactor": 0.0, "roughnessFactor": 0.7}


@dataclass
class Buffer:
    """The binary part of a file as it grows, and the JSON entries that describe it."""

    data: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def add(self, array: np.ndarray, kind: str, target: int | None = None, bounds: bool = False) -> int:
        """Append elements (N, ...) of a kind such as "VEC3", and return their accessor's index.

        Args:
            array: the elements, of a component type that glTF knows.
            kind: SCALAR, VEC3, VEC4 or MAT4.
            target: VERTICES or INDICES, for a mesh.
            bounds: whether the smallest and largest values are given, as glTF demands for times and
                positions.
        """
        about: dict[str, Any] = {"bufferView": len(self.views), "componentType": COMPONENTS[array.dtype.str]}
        about |= {"count": len(array), "type": kind}
        if bounds:
            rows = array.reshape(len(array), -1)
            about |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.views.append(view | ({} if target is None else {"target": target}))
        self.data += array.tobytes() + bytes(-array.nbytes % 4)  # each view begins at a multiple of 4 bytes
        self.accessors.append(about)
        return len(self.accessors) - 1


def joint_nodes(bind: np.ndarray) -> list[dict[str, Any]]:
    """Return the nodes of the 22 joints in the bind pose (22, 3), metres."""
    nodes: list[dict[str, Any]] = []
    for joint, parent in enumerate(PARENTS):
        offset = bind[joint] - (bind[parent] if joint else 0)
        children = [child for child, above in enumerate(PARENTS) if above == joint]
        node = {"name": JOINTS[joint], "translation": offset.tolist()}
        nodes.append(node | ({"children": children} if children else {}))
    return nodes


def skin(buffer: Buffer, bind: np.ndarray) -> dict[str, Any]:
    """Return the skin: the joints, and the matrices from the bind pose (22, 3) to each joint's frame."""
    inverse = np.tile(np.eye(4, dtype="<f4"), (N_JOINTS, 1, 1))
    inverse[:, 3, :3] = -bind  # glTF stores matrices by columns
    joints = list(range(N_JOINTS))
    return {"joints": joints, "skeleton": 0, "inverseBindMatrices": buffer.add(inverse, "MAT4")}


def _animation(buffer: Buffer, clip: Clip, rest: np.ndarray) -> dict[str, Any]:
    """Return the animation: each joint's rotation and the root's translation, at the clip's frames."""
    quaternions, root = _curves(clip, rest)
    times = buffer.add((np.arange(len(clip)) / clip.fps).astype("<f4"), "SCALAR", bounds=True)
    outputs = [(0, "translation", buffer.add(root, "VEC3"))]
    for joint in range(N_JOINTS):
        outputs.append((joint, "rotation", buffer.add(np.ascontiguousarray(quaternions[:, joint]), "VEC4")))
    return {
        "name": clip.name.encode("utf-8", "replace").decode(),
        "samplers": [{"input": times, "interpolation": "LINEAR", "output": made} for *_, made in outputs],
        "channels": [
            {"sampler": index, "target": {"node": joint, "path": path}}
            for index, (joint, path, _) in enumerate(outputs)
        ],
    }


def _curves(clip: Clip, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the joints' quaternions xyzw (N, 22, 4) and the root's positions (N, 3), metres, float32."""
    quaternions = np.empty((len(clip), N_JOINTS, 4), "<f4")
    roots = np.empty((len(clip), 3), "<f4")
    end = 0
    for piece in clip.pieces():
        rotations, root = y_up_motion(piece, rest)
        before = quaternions[end - 1] if end else None
        here = slice(end, end := end + len(piece))
        quaternions[here], roots[here] = continuous_quaternions(rotations, before), root
    return quaternions, roots


def continuous_quaternions(rotations: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
    """Return unit quaternions xyzw (N, J, 4) of rotations (N, J, 3, 3).

    Two quaternions stand for each rotation; each frame has the one nearer to the frame before. The first
    frame's are near the quaternions (J, 4) `before` it, if there are some.
    """
    quaternions = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_quat().reshape(*rotations.shape[:2], 4)
    away = (quaternions[1:] * quaternions[:-1]).sum(-1, keepdims=True) < 0
    quaternions[1:] *= np.cumprod(np.where(away, -1, 1), axis=0)
    if before is not None:
        quaternions *= np.where((quaternions[0] * before).sum(-1, keepdims=True) < 0, -1, 1)
    return quaternions


class Mesh(NamedTuple):
    """Triangles, each vertex of which follows one joint.

    Attributes:
        positions: vertices (V, 3), metres, in the bind pose.
        normals: unit normals (V, 3).
        joints: the joint (V,) that each vertex follows.
        triangles: vertices' indices (T, 3), counter-clockwise seen from outside.
    """

    positions: np.ndarray
    normals: np.ndarray
    joints: np.ndarray
    triangles: np.ndarray


def mannequin(bind: np.ndarray) -> Mesh:
    """Return the limbs of the bind pose (22, 3), metres, as capsules."""
    return merged([capsule(limb.first, limb.radii, *ends(limb, bind)) for limb in LIMBS])


def merged(parts: Sequence[Mesh]) -> Mesh:
    """Return several meshes as one."""
    starts = np.cumsum([0, *(len(part.positions) for part in parts)])
    return Mesh(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.joints for part in parts]),
        np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=False)]),
    )


def capsule(joint: int, radii: tuple[float, float], start: np.ndarray, end: np.ndarray) -> Mesh:
    """Return a round limb that follows a joint: rings around its axis that narrow to a point at both ends.

    Args:
        joint: the joint.
        radii: the radii at its ends, metres.
        start, end: its ends (3,), metres, in the bind pose.
    """
    along = (end - start) / np.linalg.norm(end - start)
    side = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    side /= np.linalg.norm(side)
    turn = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
    ring = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(along, side)
    cap = np.linspace(0, np.pi / 2, CAP)
    height = np.concatenate([cap - np.pi / 2, cap])  # latitudes of the rings: start's half sphere, then end's
    normals = np.cos(height)[:, None, None] * ring + np.sin(height)[:, None, None] * along
    centres = np.repeat([start, end], CAP, axis=0)[:, None]
    around = np.repeat(radii, CAP)[:, None, None]
    positions = centres + around * normals
    joints = np.full(normals.shape[0] * AROUND, joint)
    return Mesh(positions.reshape(-1, 3), normals.reshape(-1, 3), joints, _tube(2 * CAP))


def _tube(rings: int) -> np.ndarray:
    """Return the triangles (T, 3) between rings of AROUND vertices, one ring after the other."""
    this = np.arange((rings - 1) * AROUND)
    beside = this // AROUND * AROUND + (this + 1) % AROUND
    above, aslant = this + AROUND, beside + AROUND
    return np.concatenate([np.stack([this, beside, aslant], 1), np.stack([this, aslant, above], 1)])


def primitive(buffer: Buffer, mesh: Mesh, material: int = 0) -> dict[str, Any]:
    """Return the mesh as a glTF primitive, with four joints per vertex, of which only one is used."""
    joints = np.zeros((len(mesh.joints), 4), "|u1")
    weights = np.zeros((len(mesh.joints), 4), "<f4")
    joints[:, 0], weights[:, 0] = mesh.joints, 1
    attributes = {
        "POSITION": buffer.add(mesh.positions.astype("<f4"), "VEC3", VERTICES, bounds=True),
        "NORMAL": buffer.add(mesh.normals.astype("<f4"), "VEC3", VERTICES),
        "JOINTS_0": buffer.add(joints, "VEC4", VERTICES),
        "WEIGHTS_0": buffer.add(weights, "VEC4", VERTICES),
    }
    indices = buffer.add(mesh.triangles.astype("<u2").reshape(-1), "SCALAR", INDICES)
    return {"attributes": attributes, "indices": indices, "material": material}


def write_glb(path: Path, content: dict[str, Any], buffer: Buffer) -> None:
    """Write a file atomically: a header, a chunk of JSON, and a chunk of binary data.

    Args:
        path: the file.
        content: the JSON, without the buffer's entries.
        buffer: the binary data.
    """
    buffers = {"accessors": buffer.accessors, "bufferViews": buffer.views}
    size = len(buffer.data)
    text = json.dumps(
        content | buffers | {"buffers": [{"byteLength": size}]}, separators=(",", ":"), allow_nan=False
    )
    encoded = text.encode()
    encoded += b" " * (-len(encoded) % 4)
    with atomic_file(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(encoded) + size))
        file.write(struct.pack("<I4s", len(encoded), b"JSON") + encoded)
        file.write(struct.pack("<I4s", size, b"BIN\0"))
        file.write(buffer.data)
