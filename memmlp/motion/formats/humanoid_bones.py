"""SMPL's 22 joints as the bones of a humanoid, by the names that Unity and VRM have for them."""

from __future__ import annotations

from memmlp.motion.body import JOINTS

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


UNITY = tuple(_bone(joint) for joint in JOINTS)
"""The bone of each joint, as in Unity's HumanBodyBones."""

VRM = tuple(name[0].lower() + name[1:] for name in UNITY)
"""The bone of each joint, as in VRM 1.0."""
