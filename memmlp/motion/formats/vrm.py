"""Writes a mannequin as a VRM 1.0 avatar, which anybody may use for anything (CC0).

It is a glTF file with the extension VRMC_vrm (vrm-consortium/vrm-specification, VRMC_vrm-1.0): the 22 joints
as humanoid bones, in T-pose on the floor, facing +Z. Two eyes show the direction of the gaze.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import memmlp
from memmlp.motion.body import HEAD, JOINTS
from memmlp.motion.formats.gltf import (
    Buffer,
    Mesh,
    capsule,
    mannequin,
    merge_meshes,
    skinned_figure,
    write_glb,
)

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
    """Write a mannequin with these rest joints (22, 3), metres, as a .vrm file, atomically."""
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
    """Return the eyes of a bind pose (22, 3), metres: two upright ovals on the face."""
    radius, half, above, before = EYES
    middles = [bind[HEAD] + [side * half, above, before] for side in (-1, 1)]
    up = np.array([0, radius / 2, 0])
    return merge_meshes([capsule(HEAD, (radius, radius), middle - up, middle + up) for middle in middles])
