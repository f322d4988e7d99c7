"""Writes clips as glTF 2.0 files (.glb) with a mannequin skinned to 22 nodes, and the mannequin as VRM.

The world has glTF's conventions: right-handed, Y up, metres, seconds. In the bind pose the person stands in
T-pose on the floor and faces +Z. Each joint has a node with the joint's name and local rotation. Only the
root is translated. The format is specified by the Khronos Group (glTF 2.0.1).
"""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import memmlp
from memmlp.common.files import atomic_write
from memmlp.motion.body import CHILDREN, HEAD, JOINTS, LIMBS, N_JOINTS, PARENTS, find_limb_ends
from memmlp.motion.clip import Clip, convert_to_y_up

COMPONENTS = {"<f4": 5126, "<u2": 5123, "|u1": 5121}  # glTF's codes for component types
VERTICES, INDICES = 34962, 34963  # glTF's codes for buffer view targets
COLOUR = (0.38, 0.44, 0.50, 1.0)  # colour of the mannequin: linear RGB and opacity
AROUND, CAP = 16, 4  # number of vertices around a limb; number of rings per half sphere


def write_gltf(path: Path, clip: Clip, rest: np.ndarray) -> None:
    """Write a clip as a .glb file, atomically, on a body with rest joints `rest` (22, 3), metres."""
    buffer = Buffer()
    bind = rest - [0, rest[:, 1].min(), 0]  # the lowest joint on the floor
    figure = build_skinned_figure(buffer, bind, [build_mannequin(bind)])
    content = {"materials": [make_material("mannequin", COLOUR, 0.7)]}
    content |= {"animations": [_build_animation(buffer, clip, rest)]}
    atomic_write(path, encode_glb({**figure, **content}, buffer))


def make_material(name: str, colour: tuple[float, float, float, float], roughness: float) -> dict[str, Any]:
    """Make a material of a linear RGB colour with opacity."""
    look = {"baseColorFactor": colour, "metallicFactor": 0.0, "roughnessFactor": roughness}
    return {"name": name, "pbrMetallicRoughness": look}


@dataclass
class Buffer:
    """The growing binary part of a file, and the JSON entries that describe its content."""

    data: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def add(self, array: np.ndarray, kind: str, target: int | None = None, bounds: bool = False) -> int:
        """Append an array (N, ...) with a type in `COMPONENTS`, and return the index of its accessor. `kind`
        is SCALAR, VEC3, VEC4 or MAT4; `target` is VERTICES or INDICES, for a mesh. glTF requires `bounds`
        (minimum and maximum) for times and positions."""
        view_index, component = len(self.views), COMPONENTS[array.dtype.str]
        accessor: dict[str, Any] = {"bufferView": view_index, "componentType": component}
        accessor |= {"count": len(array), "type": kind}
        if bounds:
            rows = array.reshape(len(array), -1)
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.views.append(view | ({} if target is None else {"target": target}))
        self.data += array.tobytes() + bytes(-array.nbytes % 4)  # each view begins at a multiple of 4 bytes
        self.accessors.append(accessor)
        return len(self.accessors) - 1


class Mesh(NamedTuple):
    """A triangle mesh in which each vertex follows one joint (V,): vertices (V, 3), metres, in the bind pose,
    unit normals (V, 3), and triangles (T, 3), counter-clockwise when seen from outside."""

    positions: np.ndarray
    normals: np.ndarray
    joints: np.ndarray
    triangles: np.ndarray


def build_skinned_figure(buffer: Buffer, bind: np.ndarray, parts: Sequence[Mesh]) -> dict[str, Any]:
    """Build the glTF content for meshes that follow the 22 joints, without materials, and add them to the
    buffer. `bind` is the joint positions in the bind pose (22, 3), metres. Mesh i of `parts` has material i.
    """
    nodes: list[dict[str, Any]] = []
    for joint, parent in enumerate(PARENTS):
        offset = bind[joint] - (bind[parent] if joint else 0)
        node = {"name": JOINTS[joint], "translation": offset.tolist()}
        nodes.append(node | ({"children": CHILDREN[joint]} if CHILDREN[joint] else {}))
    inverse = np.tile(np.eye(4, dtype="<f4"), (N_JOINTS, 1, 1))
    inverse[:, 3, :3] = -bind  # glTF stores matrices by columns
    matrices = buffer.add(inverse, "MAT4")
    skin = {"joints": list(range(N_JOINTS)), "skeleton": 0, "inverseBindMatrices": matrices}
    primitives = [_build_primitive(buffer, part, material) for material, part in enumerate(parts)]
    return {
        "asset": {"version": "2.0", "generator": f"memmlp {memmlp.__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0, N_JOINTS]}],
        "nodes": [*nodes, {"name": "mannequin", "mesh": 0, "skin": 0}],
        "skins": [skin],
        "meshes": [{"name": "mannequin", "primitives": primitives}],
    }


def _build_primitive(buffer: Buffer, mesh: Mesh, material: int) -> dict[str, Any]:
    """Build a glTF primitive from a mesh. Of the four joints per vertex, only the first has weight."""
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


def _build_animation(buffer: Buffer, clip: Clip, rest: np.ndarray) -> dict[str, Any]:
    quaternions = np.empty((len(clip), N_JOINTS, 4), "<f4")
    root = np.empty((len(clip), 3), "<f4")
    end = 0
    for piece in clip.split_into_pieces():
        rotations, positions = convert_to_y_up(piece, rest)
        before = quaternions[end - 1] if end else None
        here = slice(end, end := end + len(piece))
        quaternions[here], root[here] = compute_continuous_quaternions(rotations, before), positions
    times = buffer.add((np.arange(len(clip)) / clip.fps).astype("<f4"), "SCALAR", bounds=True)
    outputs = [(0, "translation", buffer.add(root, "VEC3"))]
    for joint in range(N_JOINTS):
        outputs.append((joint, "rotation", buffer.add(np.ascontiguousarray(quaternions[:, joint]), "VEC4")))
    return {
        "name": clip.name.encode("utf-8", "replace").decode(),
        "samplers": [{"input": times, "interpolation": "LINEAR", "output": output} for *_, output in outputs],
        "channels": [
            {"sampler": index, "target": {"node": joint, "path": path}}
            for index, (joint, path, _) in enumerate(outputs)
        ],
    }


def compute_continuous_quaternions(rotations: np.ndarray, previous: np.ndarray | None = None) -> np.ndarray:
    """Convert rotations (N, J, 3, 3) to unit quaternions xyzw (N, J, 4). A rotation has two quaternions. Each
    frame gets the one nearer to the previous frame (J, 4)."""
    quaternions = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_quat().reshape(*rotations.shape[:2], 4)
    away = (quaternions[1:] * quaternions[:-1]).sum(-1, keepdims=True) < 0
    quaternions[1:] *= np.cumprod(np.where(away, -1, 1), axis=0)
    if previous is not None:
        quaternions *= np.where((quaternions[0] * previous).sum(-1, keepdims=True) < 0, -1, 1)
    return quaternions


def build_mannequin(bind: np.ndarray) -> Mesh:
    """Build a mannequin from round limbs in the bind pose (22, 3), metres."""
    ends = ((limb, find_limb_ends(limb, bind)) for limb in LIMBS)
    return merge_meshes([build_capsule(limb.first_joint, limb.radii, *pair) for limb, pair in ends])


def merge_meshes(parts: Sequence[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(part.positions) for part in parts)])
    triangles = [part.triangles + start for part, start in zip(parts, starts, strict=False)]
    positions, normals, joints = map(np.concatenate, zip(*(part[:3] for part in parts), strict=True))
    return Mesh(positions, normals, joints, np.concatenate(triangles))


def build_capsule(joint: int, radii: tuple[float, float], start: np.ndarray, end: np.ndarray) -> Mesh:
    """Build the mesh of a round limb that follows a joint: a cone with half spheres at its ends. Radii and
    ends (3,) are in metres, in the bind pose."""
    along = (end - start) / np.linalg.norm(end - start)
    side = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    side /= np.linalg.norm(side)
    turn = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
    ring = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(along, side)
    cap = np.linspace(0, np.pi / 2, CAP)
    height = np.concatenate([cap - np.pi / 2, cap])  # latitudes of the rings in both half spheres
    normals = np.cos(height)[:, None, None] * ring + np.sin(height)[:, None, None] * along
    centres = np.repeat([start, end], CAP, axis=0)[:, None]
    positions = centres + np.repeat(radii, CAP)[:, None, None] * normals
    corner = np.arange((len(normals) - 1) * AROUND)  # one corner of each square between the rings
    beside = corner // AROUND * AROUND + (corner + 1) % AROUND
    above, aslant = corner + AROUND, beside + AROUND
    triangles = np.concatenate([np.stack([corner, beside, aslant], 1), np.stack([corner, aslant, above], 1)])
    joints = np.full(len(normals) * AROUND, joint)
    return Mesh(positions.reshape(-1, 3), normals.reshape(-1, 3), joints, triangles)


def encode_glb(content: dict[str, Any], buffer: Buffer) -> bytes:
    """Return a .glb file: a header, a chunk of JSON `content`, to which the buffer's entries are added, and a
    binary chunk."""
    size = len(buffer.data)
    buffers = {"accessors": buffer.accessors, "bufferViews": buffer.views, "buffers": [{"byteLength": size}]}
    encoded = json.dumps(content | buffers, separators=(",", ":"), allow_nan=False).encode()
    encoded += b" " * (-len(encoded) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 28 + len(encoded) + size)
    chunk = struct.pack("<I4s", len(encoded), b"JSON") + encoded
    return b"".join([header, chunk, struct.pack("<I4s", size, b"BIN\0"), buffer.data])


# VRM 1.0 (vrm-consortium/vrm-specification, VRMC_vrm-1.0): a glTF file with the 22 joints as humanoid bones

UNITY_BONES = (
    "Hips", "LeftUpperLeg", "RightUpperLeg", "Spine", "LeftLowerLeg", "RightLowerLeg", "Chest", "LeftFoot",
    "RightFoot", "UpperChest", "LeftToes", "RightToes", "Neck", "LeftShoulder", "RightShoulder", "Head",
    "LeftUpperArm", "RightUpperArm", "LeftLowerArm", "RightLowerArm", "LeftHand", "RightHand",
)  # fmt: skip
"""Each joint's bone in Unity's HumanBodyBones."""

VRM_BONES = tuple(name[0].lower() + name[1:] for name in UNITY_BONES)  # each joint's bone in VRM 1.0

LOOKS = (("body", (0.30, 0.42, 0.56, 1.0), 0.7), ("eyes", (0.012, 0.016, 0.022, 1.0), 0.25))
"""Name of the material, its linear RGB and opacity, and its roughness."""

# metres: radius; distance to the side of, above and in front of the head joint
EYES = 0.016, 0.036, 0.055, 0.100

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


def encode_vrm(rest: np.ndarray) -> bytes:
    """Return a mannequin as a VRM 1.0 avatar (.vrm), for a body with rest joints (22, 3), metres. Its licence
    is CC0. It stands in T-pose on the floor and faces +Z."""
    buffer = Buffer()
    bind = rest - [0, rest[:, 1].min(), 0]
    figure = build_skinned_figure(buffer, bind, [build_mannequin(bind), build_eyes(bind)])
    humanoid = {"humanBones": {bone: {"node": joint} for joint, bone in enumerate(VRM_BONES)}}
    extension = {
        "extensionsUsed": ["VRMC_vrm"],
        "extensions": {"VRMC_vrm": {"specVersion": "1.0", "meta": META, "humanoid": humanoid}},
    }
    return encode_glb({**figure, **extension, "materials": [make_material(*look) for look in LOOKS]}, buffer)


def build_eyes(bind: np.ndarray) -> Mesh:
    """Build the eyes for a bind pose (22, 3), metres: two upright ovals that show the head's direction."""
    radius, half, above, before = EYES
    middles = [bind[HEAD] + [side * half, above, before] for side in (-1, 1)]
    up, radii = np.array([0, radius / 2, 0]), (radius, radius)
    return merge_meshes([build_capsule(HEAD, radii, middle - up, middle + up) for middle in middles])
