"""Writes clips as glTF 2.0 (.glb), with a mannequin that is skinned to 22 nodes, and the mannequin as VRM.

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
from memmlp.motion.body import HEAD, JOINTS, N_JOINTS, PARENTS
from memmlp.motion.clip import Clip, y_up_motion
from memmlp.motion.limb_shapes import LIMBS, ends

COMPONENTS = {"<f4": 5126, "<u2": 5123, "|u1": 5121}  # glTF's numbers for types of components
VERTICES, INDICES = 34962, 34963  # kinds of buffer views
COLOUR = (0.38, 0.44, 0.50, 1.0)  # of the mannequin, linear RGB and opacity
AROUND, CAP = 16, 4  # vertices around a limb; rings of the half sphere at each of its ends


def write_gltf(path: Path, clip: Clip, rest: np.ndarray) -> None:
    """Write a clip on a body with these rest joints (22, 3), metres, as a .glb file, atomically."""
    buffer = Buffer()
    bind = rest - [0, rest[:, 1].min(), 0]  # the lowest joint on the floor
    look = {"baseColorFactor": COLOUR, "metallicFactor": 0.0, "roughnessFactor": 0.7}
    figure = skinned_figure(buffer, bind, [mannequin(bind)])
    materials = [{"name": "mannequin", "pbrMetallicRoughness": look}]
    animations = [_animation(buffer, clip, rest)]
    write_glb(path, {**figure, "materials": materials, "animations": animations}, buffer)


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
        accessor: dict[str, Any] = {
            "bufferView": len(self.views), "componentType": COMPONENTS[array.dtype.str],
            "count": len(array), "type": kind,
        }  # fmt: skip
        if bounds:
            rows = array.reshape(len(array), -1)
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.views.append(view | ({} if target is None else {"target": target}))
        self.data += array.tobytes() + bytes(-array.nbytes % 4)  # each view begins at a multiple of 4 bytes
        self.accessors.append(accessor)
        return len(self.accessors) - 1


class Mesh(NamedTuple):
    """Triangles with vertices that each follow one joint.

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


def skinned_figure(buffer: Buffer, bind: np.ndarray, parts: Sequence[Mesh]) -> dict[str, Any]:
    """Return the glTF content of meshes that follow the 22 joints, without materials.

    Args:
        buffer: gets the meshes.
        bind: the joints in the bind pose (22, 3), metres.
        parts: the meshes; each has the material of its index.
    """
    nodes: list[dict[str, Any]] = []
    for joint, parent in enumerate(PARENTS):
        offset = bind[joint] - (bind[parent] if joint else 0)
        children = [child for child, above in enumerate(PARENTS) if above == joint]
        node = {"name": JOINTS[joint], "translation": offset.tolist()}
        nodes.append(node | ({"children": children} if children else {}))
    inverse = np.tile(np.eye(4, dtype="<f4"), (N_JOINTS, 1, 1))
    inverse[:, 3, :3] = -bind  # glTF stores matrices by columns
    matrices = buffer.add(inverse, "MAT4")
    skin = {"joints": list(range(N_JOINTS)), "skeleton": 0, "inverseBindMatrices": matrices}
    primitives = [_primitive(buffer, part, material) for material, part in enumerate(parts)]
    return {
        "asset": {"version": "2.0", "generator": f"memmlp {memmlp.__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0, N_JOINTS]}],
        "nodes": [*nodes, {"name": "mannequin", "mesh": 0, "skin": 0}],
        "skins": [skin],
        "meshes": [{"name": "mannequin", "primitives": primitives}],
    }


def _primitive(buffer: Buffer, mesh: Mesh, material: int) -> dict[str, Any]:
    """Return a mesh as a glTF primitive. It has four joints per vertex; three of them have no weight."""
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


def _animation(buffer: Buffer, clip: Clip, rest: np.ndarray) -> dict[str, Any]:
    quaternions = np.empty((len(clip), N_JOINTS, 4), "<f4")
    root = np.empty((len(clip), 3), "<f4")
    end = 0
    for piece in clip.pieces():
        rotations, positions = y_up_motion(piece, rest)
        before = quaternions[end - 1] if end else None
        here = slice(end, end := end + len(piece))
        quaternions[here], root[here] = continuous_quaternions(rotations, before), positions
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


def continuous_quaternions(rotations: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
    """Return unit quaternions xyzw (N, J, 4) of rotations (N, J, 3, 3).

    Two quaternions stand for each rotation; each frame has the one nearer to the frame before. The first
    frame's are near the quaternions (J, 4) `before` it, if they are given.
    """
    quaternions = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_quat().reshape(*rotations.shape[:2], 4)
    away = (quaternions[1:] * quaternions[:-1]).sum(-1, keepdims=True) < 0
    quaternions[1:] *= np.cumprod(np.where(away, -1, 1), axis=0)
    if before is not None:
        quaternions *= np.where((quaternions[0] * before).sum(-1, keepdims=True) < 0, -1, 1)
    return quaternions


def mannequin(bind: np.ndarray) -> Mesh:
    """Return the limbs of the bind pose (22, 3), metres, as capsules."""
    return merge_meshes([capsule(limb.first, limb.radii, *ends(limb, bind)) for limb in LIMBS])


def merge_meshes(parts: Sequence[Mesh]) -> Mesh:
    """Return several meshes as one."""
    starts = np.cumsum([0, *(len(part.positions) for part in parts)])
    triangles = [part.triangles + start for part, start in zip(parts, starts, strict=False)]
    positions, normals, joints = map(np.concatenate, zip(*(part[:3] for part in parts), strict=True))
    return Mesh(positions, normals, joints, np.concatenate(triangles))


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
    positions = centres + np.repeat(radii, CAP)[:, None, None] * normals
    corner = np.arange((len(normals) - 1) * AROUND)  # of the squares between the rings
    beside = corner // AROUND * AROUND + (corner + 1) % AROUND
    above, aslant = corner + AROUND, beside + AROUND
    triangles = np.concatenate([np.stack([corner, beside, aslant], 1), np.stack([corner, aslant, above], 1)])
    joints = np.full(len(normals) * AROUND, joint)
    return Mesh(positions.reshape(-1, 3), normals.reshape(-1, 3), joints, triangles)


def write_glb(path: Path, content: dict[str, Any], buffer: Buffer) -> None:
    """Write a file atomically: a header, a chunk of JSON, and a chunk of binary data.

    Args:
        path: the file.
        content: the JSON, without the buffer's entries.
        buffer: the binary data.
    """
    size = len(buffer.data)
    buffers = {"accessors": buffer.accessors, "bufferViews": buffer.views, "buffers": [{"byteLength": size}]}
    encoded = json.dumps(content | buffers, separators=(",", ":"), allow_nan=False).encode()
    encoded += b" " * (-len(encoded) % 4)
    with atomic_file(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(encoded) + size))
        file.write(struct.pack("<I4s", len(encoded), b"JSON") + encoded)
        file.write(struct.pack("<I4s", size, b"BIN\0"))
        file.write(buffer.data)


# VRM 1.0 (vrm-consortium/vrm-specification, VRMC_vrm-1.0): a glTF file with the 22 joints as humanoid bones

_MIDDLE = {
    "pelvis": "Hips", "spine1": "Spine", "spine2": "Chest", "spine3": "UpperChest", "neck": "Neck",
    "head": "Head",
}  # fmt: skip
_SIDES = {
    "hip": "UpperLeg", "knee": "LowerLeg", "ankle": "Foot", "foot": "Toes", "collar": "Shoulder",
    "shoulder": "UpperArm", "elbow": "LowerArm", "wrist": "Hand",
}  # fmt: skip


def _bone(joint: str) -> str:
    side, _, name = joint.partition("_")
    return side.capitalize() + _SIDES[name] if name else _MIDDLE[joint]


UNITY_BONES = tuple(_bone(joint) for joint in JOINTS)
"""The bone of each joint, as in Unity's HumanBodyBones."""

VRM_BONES = tuple(name[0].lower() + name[1:] for name in UNITY_BONES)
"""The bone of each joint, as in VRM 1.0."""

LOOKS = (("body", (0.30, 0.42, 0.56, 1.0), 0.7), ("eyes", (0.012, 0.016, 0.022, 1.0), 0.25))
"""Material, linear RGB and opacity, roughness."""

EYES = (0.016, 0.036, 0.055, 0.100)  # metres: radius; to either side, above and before the head's joint

META = {
    "name": "memmlp mannequin",
    "version": memmlp.__version__,
    "authors": ["The memmlp developers"],
    "licenseUrl": "https://vrm.dev/licenses/1.0/",
    "otherLicenseUrl": "https://creativecommons.org/publicdomain/zero/1.0/",
    "avatarPermission": "everyone",
    "allowExcessivelyViolentUsage": True,
    "allowExcessivelySexualUsage": True,
    "commercialUsage": "corporation",
    "allowPoliticalOrReligiousUsage": True,
    "allowAntisocialOrHateUsage": True,
    "creditNotation": "unnecessary",
    "allowRedistribution": True,
    "modification": "allowModificationRedistribution",
}


def write_vrm(path: Path, rest: np.ndarray) -> None:
    """Write a mannequin with these rest joints (22, 3), metres, as a VRM 1.0 avatar (.vrm), atomically.

    It stands in T-pose on the floor and faces +Z. Anybody may use it for anything (CC0).
    """
    buffer = Buffer()
    bind = rest - [0, rest[:, 1].min(), 0]
    figure = skinned_figure(buffer, bind, [mannequin(bind), eyes(bind)])
    humanoid = {"humanBones": {bone: {"node": joint} for joint, bone in enumerate(VRM_BONES)}}
    extension = {
        "extensionsUsed": ["VRMC_vrm"],
        "extensions": {"VRMC_vrm": {"specVersion": "1.0", "meta": META, "humanoid": humanoid}},
    }
    materials = []
    for name, colour, roughness in LOOKS:
        look = {"baseColorFactor": colour, "metallicFactor": 0.0, "roughnessFactor": roughness}
        materials.append({"name": name, "pbrMetallicRoughness": look})
    write_glb(path, {**figure, **extension, "materials": materials}, buffer)


def eyes(bind: np.ndarray) -> Mesh:
    """Return the eyes of a bind pose (22, 3), metres: two upright ovals on the face, which show the gaze."""
    radius, half, above, before = EYES
    middles = [bind[HEAD] + [side * half, above, before] for side in (-1, 1)]
    up = np.array([0, radius / 2, 0])
    return merge_meshes([capsule(HEAD, (radius, radius), middle - up, middle + up) for middle in middles])
