"""Writes a mannequin as a VRM 1.0 avatar, which anybody may use for anything (CC0).

It is a glTF file with the extension VRMC_vrm (vrm-consortium/vrm-specification, VRMC_vrm-1.0): the 22 joints
as humanoid bones, in T-pose on the floor, facing +Z. Two eyes tell where it looks.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import memmlp
from memmlp.motion.body import HEAD, N_JOINTS
from memmlp.motion.formats.gltf_writer import (
    Buffer,
    Mesh,
    capsule,
    joint_nodes,
    mannequin,
    merged,
    primitive,
    skin,
    write_glb,
)
from memmlp.motion.formats.humanoid_bones import VRM

COLOURS = ((0.30, 0.42, 0.56, 1.0), (0.012, 0.016, 0.022, 1.0))  # of body and eyes, linear RGB and opacity
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
    parts = (mannequin(bind), eyes(bind))
    write_glb(
        path,
        {
            "asset": {"version": "2.0", "generator": f"memmlp {memmlp.__version__}"},
            "extensionsUsed": ["VRMC_vrm"],
            "extensions": {"VRMC_vrm": {"specVersion": "1.0", "meta": META, "humanoid": _humanoid()}},
            "scene": 0,
            "scenes": [{"nodes": [0, N_JOINTS]}],
            "nodes": [*joint_nodes(bind), {"name": "mannequin", "mesh": 0, "skin": 0}],
            "skins": [skin(buffer, bind)],
            "meshes": [
                {
                    "name": "mannequin",
                    "primitives": [primitive(buffer, part, index) for index, part in enumerate(parts)],
                }
            ],
            "materials": [_material(*look) for look in LOOKS],
        },
        buffer,
    )


LOOKS = (("body", COLOURS[0], 0.7), ("eyes", COLOURS[1], 0.25))


def _material(name: str, colour: tuple[float, ...], roughness: float) -> dict[str, Any]:
    look = {"baseColorFactor": colour, "metallicFactor": 0.0, "roughnessFactor": roughness}
    return {"name": name, "pbrMetallicRoughness": look}


def _humanoid() -> dict[str, Any]:
    """Return which node is which bone; a joint's node has the joint's index."""
    return {"humanBones": {bone: {"node": joint} for joint, bone in enumerate(VRM)}}


def eyes(bind: np.ndarray) -> Mesh:
    """Return the eyes of a bind pose (22, 3), metres: two upright ovals on the face."""
    radius, half, above, before = EYES
    middles = [bind[HEAD] + [side * half, above, before] for side in (-1, 1)]
    up = np.array([0, radius / 2, 0])
    return merged([capsule(HEAD, (radius, radius), middle - up, middle + up) for middle in middles])
