"""Skeleton maps: which joint of a BVH file stands for which of the 22 body joints, as YAML."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from memmlp.common.errors import InputError
from memmlp.motion.body import JOINTS
from memmlp.motion.clip import FRAME_RATE_RANGE
from memmlp.motion.formats.bvh import Bvh

SKELETONS = Path(__file__).parent / "skeletons"
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # Y-up axes to the world's: y becomes z
HIPS = (1, 2)
LEGS = {1: 4, 2: 5, 4: 7, 5: 8}  # joint -> the joint at the other end of its bone
LIMBS = LEGS | {16: 18, 17: 19, 18: 20, 19: 21}
REQUIRED = ("pelvis", "head", *(JOINTS[joint] for joint in sorted({*LIMBS, *LIMBS.values()})))


@dataclass(frozen=True)
class SkeletonMap:
    """The map of a family of source skeletons.

    Attributes:
        name: the map's name.
        unit: the file's unit in metres.
        up: the file's up axis, `y` (zero pose facing +Z) or `z` (facing -Y); left is +X in both.
        calibration_frame: whether frame 0 is a calibration pose, not motion.
        joints: body joint -> the BVH node (a joint, or `<joint>.end`) that stands for it.
        rates: true frame rates, Hz, of folders whose headers are known to be wrong.
    """

    name: str
    unit: float
    up: str
    calibration_frame: bool
    joints: dict[str, str]
    rates: dict[str, float] = field(default_factory=dict)

    @property
    def upright(self) -> np.ndarray:
        """The rotation (3, 3) from the file's axes to Y-up axes."""
        return np.eye(3) if self.up == "y" else Z_UP.T


def shipped_skeletons() -> tuple[str, ...]:
    """Return the names of the maps in the package."""
    return tuple(sorted(path.stem for path in SKELETONS.glob("*.yaml")))


def load_skeleton(which: str) -> SkeletonMap:
    """Load a shipped map by its name, or a user's by its path.

    Raises:
        InputError: if there is no such file or it is no map.
    """
    path = SKELETONS / f"{which}.yaml" if which in shipped_skeletons() else Path(which)
    if not path.is_file():
        known = ", ".join(shipped_skeletons())
        raise InputError(f"skeleton: {which!r} is no file; allowed: {known}, or the path of a YAML map")
    try:
        content = yaml.load(path.read_text("utf-8"), _StrictLoader)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        brief = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: {brief}; allowed: a readable YAML map") from error
    _check_map(path, content)
    return SkeletonMap(**content)


def find_skeleton(bvh: Bvh) -> SkeletonMap:
    """Find the one shipped map all of whose nodes the file has.

    Raises:
        InputError: if there is none, or more than one.
    """
    maps = [load_skeleton(name) for name in shipped_skeletons()]
    fitting = [skeleton for skeleton in maps if set(skeleton.joints.values()) <= set(bvh.nodes)]
    if len(fitting) == 1:
        return fitting[0]
    state = "fits more than one skeleton" if fitting else "has an unknown skeleton"
    known = ", ".join(skeleton.name for skeleton in fitting or maps)
    listed = ", ".join(bvh.names[:60]) + (", ..." if len(bvh.names) > 60 else "")
    raise InputError(f"{bvh.path}: {state} with the joints {listed}; allowed: {known}, or a map by skeleton=")


class _StrictLoader(yaml.SafeLoader):
    """A YAML loader that raises ValueError for a key that stands twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        twice = [key for key, count in keys.items() if count > 1]
        if twice:
            raise ValueError(f"the key {twice[0]!r} stands twice")
        return super().construct_mapping(node, deep)


def _check_map(path: Path, content: object) -> None:
    """Raise InputError unless the YAML has exactly what a SkeletonMap needs."""

    def require(good: bool, key: str, allowed: str) -> None:
        if not good:
            raise InputError(f"{path}: {key} is wrong or missing; allowed: {allowed}")

    keys = {"name", "unit", "up", "calibration_frame", "joints"}
    if not isinstance(content, dict) or not keys <= set(content) <= keys | {"rates"}:
        raise InputError(f"{path}: not the keys of a map; allowed: {', '.join(sorted(keys))}, and rates")
    joints, rates = content["joints"], content.get("rates", {})
    require(_is_text(content["name"]), "name", "text")
    require(is_number(content["unit"], 1e-6, 1e3), "unit", "a number of metres from 1e-6 to 1000")
    require(content["up"] in ("y", "z"), "up", "y or z")
    require(isinstance(content["calibration_frame"], bool), "calibration_frame", "true or false")
    require(isinstance(rates, dict), "rates", "folder: Hz")
    for folder, rate in rates.items():
        good = _is_text(folder) and is_number(rate, *FRAME_RATE_RANGE)
        require(good, f"rates.{folder}", "a folder's name and 1 to 1000 Hz")
    require(isinstance(joints, dict), "joints", f"{', '.join(JOINTS)}, each with the file's joint")
    for joint, node in joints.items():
        allowed = f"a joint of the file for each of {', '.join(JOINTS)}"
        require(joint in JOINTS and _is_text(node), f"joints.{joint}", allowed)
    for joint in REQUIRED:
        require(joint in joints, f"joints.{joint}", f"a joint's name; {', '.join(REQUIRED)} are needed")
    node, count = Counter(joints.values()).most_common(1)[0]
    require(count == 1, f"joints: {node}", "each of the file's joints once")


def _is_text(value: object) -> bool:
    return isinstance(value, str) and value.isprintable() and value != ""


def is_number(value: object, low: float, high: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
