"""Skeleton maps: which node of a motion file stands for which of the 22 body joints, as YAML."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import yaml

from memmlp.common.errors import InputError, why_unreadable
from memmlp.motion.body import JOINTS
from memmlp.motion.importing.motion_file import MotionFile
from memmlp.motion.importing.node_names import find_nodes

SKELETONS = Path(__file__).parent / "skeletons"
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # Y-up axes to the world's: y becomes z
UPRIGHT = {"y": np.eye(3), "z": Z_UP.T}  # up axis of a file -> rotation from its axes to Y-up axes
REQUIRED = (
    "pelvis", "head", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
FOUND = "auto"  # a unit or up axis that is found in each file


@dataclass(frozen=True)
class SkeletonMap:
    """Which node of a file's skeleton stands for which of our 22 joints.

    A map has the file's unit, axes and stance, too.

    Attributes:
        name: the map's name.
        joints: body joint -> the file's node (a joint, or `<joint>.end`) that stands for it.
        unit: the file's unit in metres, None if it is to be found from the legs.
        up: the file's up axis, `y` or `z`, None if it is to be found from the motion.
        calibration_frame: whether frame 0 is a calibration pose, not motion.
        rest: the pose in which the person stands, from which the skeleton is read: `auto` (the zero pose if
            the person stands in it, else the straightest frame), a frame's number, or the rotation values,
            degrees, of joints as in a frame of the file.
        note: what users who import such files should know.
    """

    name: str
    joints: dict[str, str]
    unit: float | None = None
    up: str | None = None
    calibration_frame: bool = False
    rest: str | int | dict[str, list[float]] = FOUND
    note: str = ""

    def with_up(self, up: str | None) -> SkeletonMap:
        """Return the map with an up axis, `y` or `z`, that the user gave; None changes nothing."""
        return self if up is None else replace(self, up=up)

    @property
    def upright(self) -> np.ndarray:
        """The rotation (3, 3) from the file's axes to Y-up axes. `up` must be set."""
        return UPRIGHT[str(self.up)]


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
        raise InputError(f"{path}: {why_unreadable(error)[:120]}; allowed: a readable YAML map") from error
    return _parsed(path, content)


def find_skeleton(recording: MotionFile, chosen: SkeletonMap | None = None) -> SkeletonMap:
    """Find the shipped map all of whose nodes the file has; of several maps, the one with the most nodes.

    Of maps with equally many nodes, the one that finds unit and up axis in the file is preferred.

    Spellings and namespaces may differ (`names.find_nodes`); the returned map has the file's spellings. A map
    that the user chose is returned with the file's spellings, too, or unchanged if the file lacks some of its
    nodes.

    Raises:
        InputError: if no map fits, or several fit equally well.
    """
    if chosen is not None:
        return spelt_as_in(chosen, recording) or chosen
    maps = _shipped_maps(SKELETONS)
    fitting = [fitted for skeleton in maps if (fitted := spelt_as_in(skeleton, recording)) is not None]
    best = max(map(_rank, fitting), default=(0, 0))
    fitting = [skeleton for skeleton in fitting if _rank(skeleton) == best]
    if len(fitting) == 1:
        return fitting[0]
    state = "fits more than one skeleton" if fitting else "has an unknown skeleton"
    known = ", ".join(skeleton.name for skeleton in fitting or maps)
    names = [name for name in recording.nodes if not name.endswith(".end")]
    listed = ", ".join(names[:60]) + (", ..." if len(names) > 60 else "")
    raise InputError(
        f"{recording.path}: {state} with the joints {listed}; allowed: {known}, or a map by skeleton="
    )


@cache
def _shipped_maps(folder: Path) -> tuple[SkeletonMap, ...]:
    """Load the maps of the package's folder once: reading YAML takes longer than importing a short clip."""
    return tuple(load_skeleton(name) for name in shipped_skeletons())


def _rank(skeleton: SkeletonMap) -> tuple[int, int]:
    """Return the rank of a map among those that fit a file; the highest rank wins."""
    return len(skeleton.joints), (skeleton.unit, skeleton.up).count(None)


def spelt_as_in(skeleton: SkeletonMap, recording: MotionFile) -> SkeletonMap | None:
    """Return a map with its nodes spelt as in the file, including the file's namespace.

    Returns None if the file lacks one of the nodes.
    """
    told = skeleton.rest if isinstance(skeleton.rest, dict) else {}
    nodes = find_nodes(recording.nodes, sorted({*skeleton.joints.values(), *told}))
    if nodes is None:
        return None
    joints = {joint: nodes[node] for joint, node in skeleton.joints.items()}
    rest = {nodes[node]: turns for node, turns in told.items()} or skeleton.rest
    return replace(skeleton, joints=joints, rest=rest)


class _StrictLoader(yaml.SafeLoader):
    """A YAML loader that raises ValueError for a key that occurs twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        twice = [key for key, count in keys.items() if count > 1]
        if twice:
            raise ValueError(f"the key {twice[0]!r} stands twice")
        return super().construct_mapping(node, deep)


def _parsed(path: Path, content: object) -> SkeletonMap:
    """Return the map in a YAML file. Raises InputError unless it has what a SkeletonMap needs."""

    def require(good: bool, key: str, allowed: str) -> None:
        if not good:
            raise InputError(f"{path}: {key} is wrong or missing; allowed: {allowed}")

    needed, more = ("name", "joints"), ("unit", "up", "calibration_frame", "rest", "note")
    if not isinstance(content, dict) or not set(needed) <= set(content) <= {*needed, *more}:
        raise InputError(
            f"{path}: not the keys of a map; allowed: {', '.join(needed)}, and {', '.join(more)}"
        )
    told = {"unit": FOUND, "up": FOUND, "calibration_frame": False, "rest": FOUND, "note": "", **content}
    require(_is_text(told["name"]), "name", "text")
    numbers = "a number of metres from 1e-6 to 1000, or auto"
    require(told["unit"] == FOUND or is_number(told["unit"], 1e-6, 1e3), "unit", numbers)
    require(told["up"] in ("y", "z", FOUND), "up", "y, z or auto")
    require(isinstance(told["calibration_frame"], bool), "calibration_frame", "true or false")
    require(_is_rest(told["rest"]), "rest", "auto, a frame's number, or JOINT: [degrees, degrees, degrees]")
    require(told["note"] == "" or _is_text(told["note"]), "note", "text")
    _check_joints(require, told["joints"])
    unit, up = (None if told[key] == FOUND else told[key] for key in ("unit", "up"))
    return SkeletonMap(**{**told, "unit": unit, "up": up})


def _check_joints(require: Callable[[bool, str, str], None], joints: object) -> None:
    """Check that a map's joints are joints of the body, include the needed ones, and have different nodes."""
    require(isinstance(joints, dict), "joints", f"{', '.join(JOINTS)}, each with the file's joint")
    assert isinstance(joints, dict)
    for joint, node in joints.items():
        allowed = f"a joint of the file for each of {', '.join(JOINTS)}"
        require(joint in JOINTS and _is_text(node), f"joints.{joint}", allowed)
    for joint in REQUIRED:
        require(joint in joints, f"joints.{joint}", f"a joint's name; {', '.join(REQUIRED)} are needed")
    node, count = Counter(joints.values()).most_common(1)[0]
    require(count == 1, f"joints: {node}", "each of the file's joints once")


def _is_rest(value: object) -> bool:
    if not isinstance(value, dict):
        return value == FOUND or (isinstance(value, int) and not isinstance(value, bool) and value >= 0)
    return bool(value) and all(
        _is_text(node) and isinstance(turns, list) and all(is_number(turn, -360, 360) for turn in turns)
        for node, turns in value.items()
    )


def _is_text(value: object) -> bool:
    return isinstance(value, str) and value.isprintable() and value != ""


def is_number(value: object, low: float, high: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
