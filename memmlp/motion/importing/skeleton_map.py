"""Skeleton maps: YAML files that map the 22 body joints to the nodes of motion files."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from memmlp.common.errors import InputError, describe_read_error
from memmlp.common.schema import parse_config_yaml
from memmlp.motion.body import JOINTS, PARENTS
from memmlp.motion.formats.recording import END, Recording

SKELETONS = Path(__file__).parent / "skeletons"
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # from Y-up axes to the world: y becomes z
UPRIGHT = {"y": np.eye(3), "z": Z_UP.T}  # up axis of a file -> rotation from its axes to Y-up axes
REQUIRED = (
    "pelvis", "head", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
AUTO = "auto"  # the unit or up axis is found for each file
SEPARATORS = re.compile(r"[\W_]+")


@dataclass(frozen=True)
class SkeletonMap:
    """A map from the body's 22 joints to the nodes of a file's skeleton. `rest` is a stance, as joint ->
    rotation values in degrees, like in a frame of the file, or the index of a frame. None uses the zero pose
    if the person stands in it, else the straightest frame."""

    name: str
    joints: dict[str, str]  # body joint -> node in the file (a joint, or `<joint>.end`)
    unit: float | None = None  # the file's unit in metres; None finds it from the length of the legs
    up: str | None = None  # the file's up axis, `y` or `z`; None finds it from the motion
    calibration_frame: bool = False  # whether frame 0 is a calibration pose instead of motion
    rest: dict[str, list[float]] | int | None = None

    @property
    def upright_rotation(self) -> np.ndarray:
        """The rotation (3, 3) from the file's axes to Y-up axes; requires `up`."""
        return UPRIGHT[str(self.up)]


def list_shipped_skeletons() -> tuple[str, ...]:
    return tuple(sorted(path.stem for path in SKELETONS.glob("*.yaml")))


def load_skeleton(which: str) -> SkeletonMap:
    """Load a shipped map, given its name, or the user's map, given its path. Raises InputError if it does not
    exist or is invalid."""
    path = SKELETONS / f"{which}.yaml" if which in list_shipped_skeletons() else Path(which)
    if not path.is_file():
        names = ", ".join(list_shipped_skeletons())
        raise InputError(f"--skeleton {which}: must be one of {names}, or the path of a YAML map")
    try:
        content = parse_config_yaml(path.read_text("utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        reason = describe_read_error(error)[:120]
        raise InputError(f"{path}: {reason}; expected a readable YAML map") from error
    return _parse_map(path, content)


def find_skeleton(recording: Recording, user_map: SkeletonMap | None = None) -> SkeletonMap:
    """Find the skeleton map for a file, and adapt it to the file's spelling of nodes. A map fits if the file
    has all of its nodes. Spelling and namespaces may differ (`find_nodes`). Of several maps that fit, the map
    with the largest number of nodes is chosen, then one without a fixed unit and up axis. The user's map is
    always chosen; it stays unchanged if it does not fit. Raises InputError if no map fits, or several maps
    fit equally well."""
    if user_map is not None:
        return _respell(user_map, recording) or user_map
    maps = _load_shipped(SKELETONS)
    fitting = [fitted for skeleton in maps if (fitted := _respell(skeleton, recording)) is not None]

    def rank(skeleton: SkeletonMap) -> tuple[int, int]:
        return len(skeleton.joints), (skeleton.unit, skeleton.up).count(None)

    best = max(map(rank, fitting), default=(0, 0))
    fitting = [skeleton for skeleton in fitting if rank(skeleton) == best]
    if len(fitting) == 1:
        return fitting[0]
    problem = "fits more than one skeleton" if fitting else "has an unknown skeleton"
    names = ", ".join(skeleton.name for skeleton in fitting or maps)
    joints = [name for name in recording.nodes if not name.endswith(END)]
    found = f"{problem} with the joints {', '.join(joints[:60])}{', ...' if len(joints) > 60 else ''}"
    raise InputError(f"{recording.path}: {found}; expected one of {names}, or a map in --skeleton")


@cache
def _load_shipped(folder: Path) -> tuple[SkeletonMap, ...]:
    """Load the package's maps once, because reading YAML is slower than the import of a short clip."""
    return tuple(load_skeleton(path.stem) for path in sorted(folder.glob("*.yaml")))


def _respell(skeleton: SkeletonMap, recording: Recording) -> SkeletonMap | None:
    """Adapt a map to the file's spelling of nodes; None if the file lacks a node."""
    rest = skeleton.rest if isinstance(skeleton.rest, dict) else {}
    nodes = find_nodes(recording.nodes, sorted({*skeleton.joints.values(), *rest}))
    if nodes is None:
        return None
    joints = {joint: nodes[node] for joint, node in skeleton.joints.items()}
    return replace(skeleton, joints=joints, rest={nodes[node]: rest[node] for node in rest} or skeleton.rest)


# Names of nodes


def strip_namespace(nodes: Sequence[str]) -> list[str]:
    """Remove common prefixes of node names, such as `mixamorig:`, `Character1_` or `m_avg_`. A prefix with a
    colon is always removed. The root may lack the others' prefix. If the resulting names are not unique, the
    names stay unchanged."""
    plain = [re.sub(r".*[:|]", "", node) for node in nodes]
    for names in (plain, plain[1:]):
        prefix = _find_prefix(names) if len(names) > 1 else ""
        plain = [name.removeprefix(prefix) for name in plain]
    return plain if len(set(plain)) == len(plain) and all(plain) else list(nodes)


def _find_prefix(names: Sequence[str]) -> str:
    """Find the longest common prefix that ends at a separator or before a capital letter."""
    letters = zip(*(name.removesuffix(END) for name in names), strict=False)
    shared = "".join(each[0] for each in takewhile(lambda each: len(set(each)) == 1, letters))
    for length in range(len(shared), 0, -1):
        capital = shared[length - 1].islower() and all(name[length : length + 1].isupper() for name in names)
        if SEPARATORS.fullmatch(shared[length - 1]) or capital:
            return shared[:length]
    return ""


def find_nodes(nodes: Sequence[str], names: Sequence[str]) -> dict[str, str] | None:
    """Find the node for each name of a skeleton map: the one with the same spelling, or else exactly one with
    an equivalent spelling: `Left_hip`, `left_hip` and `x:LeftHip` are equivalent. None if a name has no node,
    or two names have the same node."""
    keys = [_normalize_name(name) for name in strip_namespace(nodes)]
    count = Counter(keys)
    unique = {key: node for key, node in zip(keys, nodes, strict=True) if count[key] == 1}
    node_of = {name: name if name in nodes else unique.get(_normalize_name(name)) for name in names}
    if None in node_of.values() or len(set(node_of.values())) < len(node_of):
        return None
    return {name: str(node) for name, node in node_of.items()}


def _normalize_name(name: str) -> str:
    stem = name.removesuffix(END)
    return SEPARATORS.sub("", stem).lower() + (END if stem != name else "")


# The YAML file


def _parse_map(path: Path, content: object) -> SkeletonMap:
    def require(good: bool, key: str, expected: str) -> None:
        if not good:
            raise InputError(f"{path}: {key} must be {expected}")

    required, optional = ("name", "joints"), ("unit", "up", "calibration_frame", "rest")
    if not isinstance(content, dict) or not set(required) <= set(content) <= {*required, *optional}:
        raise InputError(f"{path}: keys must be {', '.join(required)}, optionally {', '.join(optional)}")
    values: dict[str, Any] = {key: None if value == AUTO else value for key, value in content.items()}
    require(_is_text(values["name"]), "name", "text")
    unit, joints = values.get("unit"), values["joints"] or {}
    require(unit is None or is_number(unit, 1e-6, 1e3), "unit", "1e-6 to 1000 (metres), or auto")
    require(values.get("up") in ("y", "z", None), "up", "y, z or auto")
    require(isinstance(values.get("calibration_frame", False), bool), "calibration_frame", "true or false")
    if frame := re.fullmatch(r"frame (\d{1,6})", str(values.get("rest"))):
        values["rest"] = int(frame[1])
    elif not _is_rest(values.get("rest")):
        require(False, "rest", "auto, frame N, or JOINT: [degrees, degrees, degrees]")
    require(isinstance(joints, dict), "joints", f"a mapping of {', '.join(JOINTS)} to the file's joints")
    for joint, node in joints.items():
        is_valid = joint in JOINTS and _is_text(node)
        require(is_valid, f"joints.{joint}", f"a joint of the file for one of {', '.join(JOINTS)}")
    for joint in REQUIRED:
        require(joint in joints, f"joints.{joint}", "the name of a joint (required)")
    node, count = Counter(joints.values()).most_common(1)[0]
    require(count == 1, f"{node} in joints", "unique")
    return SkeletonMap(**values)


def _is_rest(value: object) -> bool:
    if not isinstance(value, dict) or not value:
        return value is None
    angles = [angle for turns in value.values() for angle in (turns if isinstance(turns, list) else [None])]
    return all(map(_is_text, value)) and all(is_number(angle, -360, 360) for angle in angles)


def _is_text(value: object) -> bool:
    return isinstance(value, str) and value.isprintable() and value != ""


def is_number(value: object, low: float, high: float) -> bool:
    """Return whether a YAML value is a number within two bounds."""
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


# Motion of the mapped joints


@dataclass(frozen=True)
class MappedMotion:
    """A recording's motion of the mapped joints, in Y-up axes and metres."""

    path: Path
    mapped: np.ndarray  # whether each body joint has a node in the file (22,)
    nodes: np.ndarray  # index of each body joint's node (22,); the parent joint's node for unmapped joints
    rotations: np.ndarray  # global rotations of the nodes (N, 22, 3, 3)
    positions: np.ndarray  # positions of the nodes (N, 22, 3)
    zero: np.ndarray  # positions in the zero pose (22, 3), where all rotations are the identity

    def __len__(self) -> int:
        return len(self.rotations)


def pick_joints(recording: Recording, skeleton: SkeletonMap) -> MappedMotion:
    """Select the motion of the mapped joints in a recording, without a calibration frame. Raises InputError
    if nodes of the map are missing, the order of nodes differs from the body's, or no frame remains."""
    if missing := sorted(set(skeleton.joints.values()) - set(recording.nodes)):
        raise InputError(f"{recording.path}: has no {', '.join(missing)}, unlike skeleton {skeleton.name}")
    nodes = np.zeros(len(JOINTS), int)
    for joint, parent in enumerate(PARENTS):
        node = skeleton.joints.get(JOINTS[joint])
        nodes[joint] = nodes[parent] if node is None else recording.nodes.index(node)
        above = int(nodes[joint])
        while above not in (nodes[parent], -1):
            above = recording.node_parents[above]
        if above < 0:
            wrong = f"{node} must be below {recording.nodes[nodes[parent]]} for skeleton {skeleton.name}"
            raise InputError(f"{recording.path}: {wrong}; check the map")
    first = int(skeleton.calibration_frame)
    rotations, positions = (array[first:, nodes] for array in recording.compute_kinematics())
    if len(rotations) == 0:
        raise InputError(f"{recording.path}: has only the calibration frame; must have two frames or more")
    upright, unit = skeleton.upright_rotation, skeleton.unit
    return MappedMotion(
        path=recording.path,
        mapped=np.array([joint in skeleton.joints for joint in JOINTS]),
        nodes=nodes,
        rotations=upright @ rotations @ upright.T,
        positions=unit * positions @ upright.T,
        zero=unit * recording.compute_zero_pose()[nodes] @ upright.T,
    )
