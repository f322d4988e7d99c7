"""Proposes a skeleton map for a file. The names of nodes show the limbs, and the tree shows the trunk.

Joints of arms and legs are found by typical words, each below the previous joint. The spine joints are spread
over the nodes between pelvis and arms. The head is a node named head, or else the end of the longest chain
above the arms."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.body import JOINTS, make_builtin_rest_joints
from memmlp.motion.formats.recording import END, Recording
from memmlp.motion.importing.anatomy import CHAINS
from memmlp.motion.importing.convert import JUMP, Conversion, convert_recording, measure_first_step
from memmlp.motion.importing.skeleton_map import REQUIRED, SkeletonMap, strip_namespace

LEG = {  # joint of a leg -> words that name it, the clearest first
    "hip": ("thigh", "upleg", "upperleg", "femur", "uplegs", "thighbend", "hip"),
    "knee": ("knee", "shin", "calf", "lowerleg", "lowleg", "loleg", "tibia", "leg"),
    "ankle": ("ankle", "foot"),
    "foot": ("toe", "toes", "toebase", "ball", "foot", "toe0"),
}
ARM = {
    "shoulder": ("upperarm", "uparm", "humerus", "shldr", "uarm", "shldrbend", "arm", "shoulder"),
    "elbow": ("elbow", "forearm", "lowerarm", "lowarm", "loarm", "radius", "farm", "forearmbend"),
    "wrist": ("wrist", "hand"),
}
COLLAR = ("collar", "clavicle", "thorax", "shoulder", "collarbone")
KNOWN = frozenset(
    word for each in (*LEG.values(), *ARM.values(), COLLAR) for word in each
) | {"hipjoint", "fingers", "thumb"}  # fmt: skip

SIDES = {"left": "left", "l": "left", "lf": "left", "right": "right", "r": "right", "rt": "right"}
TOKENS = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
GLUED = re.compile(r"(left|right|l|r)(.+)")  # leftupleg, lfemur


class NodeName(NamedTuple):
    """The parts of a node's name: the side (`left`, `right` or empty), and the rest in lower case."""

    side: str
    word: str


@dataclass(frozen=True)
class MapGuess:
    """A proposed map, and the joints that were found by the tree instead of by names."""

    skeleton: SkeletonMap
    by_tree: tuple[str, ...]

    @property
    def missing(self) -> tuple[str, ...]:
        """The required joints that were not found."""
        return tuple(joint for joint in REQUIRED if joint not in self.skeleton.joints)


def split_node_name(name: str) -> NodeName:
    """Split a node's name without namespace, such as `LeftUpLeg`, `UpperArm_L` or `lfemur`, into side and
    word. A side letter as in `lfemur` is split off only if the rest is a known word."""
    glued = GLUED.fullmatch(name.removesuffix(END).lower())
    if glued and glued[2] in KNOWN:
        return NodeName(SIDES[glued[1]], glued[2])
    tokens = [token.lower() for token in TOKENS.findall(name.removesuffix(END))]
    sides = {SIDES[token] for token in tokens if token in SIDES}
    word = "".join(token for token in tokens if token not in SIDES or len(sides) != 1)
    return NodeName(sides.pop() if len(sides) == 1 else "", word)


def guess_map(recording: Recording, name: str) -> MapGuess:
    """Propose a map with this name for a file."""
    tree = _Tree(recording)
    node_of: dict[str, int] = {}
    for side in ("left", "right"):
        leg, arm = tree.find_limb(side, LEG), tree.find_limb(side, ARM)
        node_of |= {f"{side}_{part}": node for part, node in (leg | arm).items()}
        if "shoulder" in arm:
            above = tree.list_path(arm["shoulder"])[:-1]
            collars = [n for n in above if tree.words[n].word in COLLAR and tree.words[n].side == side]
            node_of |= {f"{side}_collar": collars[-1]} if collars else {}
    by_name = set(node_of)
    node_of |= tree.find_trunk(node_of)
    trunk = {joint: tree.words[node_of[joint]].word for joint in ("neck", "head") if joint in node_of}
    by_name |= {joint for joint, word in trunk.items() if joint in word}
    for side in ("left", "right"):
        ankle = node_of.get(f"{side}_ankle")
        tips = [node for node, parent in enumerate(tree.parents) if parent == ankle]
        if f"{side}_foot" not in node_of and len(tips) == 1:
            node_of[f"{side}_foot"] = tips[0]
    joints = {joint: recording.nodes[node_of[joint]] for joint in JOINTS if joint in node_of}
    skeleton = SkeletonMap(name, joints, calibration_frame=measure_first_step(recording) > JUMP)
    return MapGuess(skeleton, tuple(joint for joint in joints if joint not in by_name))


class _Tree:
    def __init__(self, recording: Recording) -> None:
        self.parents, self.nodes = recording.node_parents, recording.nodes
        self.words = [split_node_name(name) for name in strip_namespace(recording.nodes)]

    def list_path(self, node: int) -> list[int]:
        """Return the path from the root to a node."""
        line = [node]
        while self.parents[line[0]] >= 0:
            line.insert(0, self.parents[line[0]])
        return line

    def is_end(self, node: int) -> bool:
        return self.nodes[node].endswith(END)

    def find_limb(self, side: str, parts: dict[str, tuple[str, ...]]) -> dict[str, int]:
        """Find the joints of a limb by the names of nodes. Each joint is below the previous one."""
        node_of: dict[str, int] = {}
        for part, spellings in parts.items():
            above = next(reversed(node_of.values()), None)
            joints = (node for node in range(len(self.nodes)) if not self.is_end(node))
            below = [node for node in joints if above is None or above in self.list_path(node)[:-1]]
            matches = [n for word in spellings for n in below if self.words[n] == (side, word)]
            if matches:
                node_of[part] = matches[0]
        return node_of

    def find_trunk(self, limbs: dict[str, int]) -> dict[str, int]:
        """Find pelvis, spine, neck and head, given the joints of the limbs."""
        ends = ("left_hip", "right_hip", "left_shoulder", "right_shoulder")
        if not set(ends) <= set(limbs):
            return {}
        lines = [self.list_path(limbs[joint]) for joint in ends]
        hips, shoulders = ([n for n in left if n in right] for left, right in (lines[:2], lines[2:]))
        shared = [node for node in hips if node in shoulders]  # up to the last common node of legs and arms
        spine = shoulders[len(shared) :]
        node_of = {"pelvis": shared[-1]}
        if spine:
            indices = np.linspace(0, len(spine) - 1, min(3, len(spine))).astype(int)
            node_of |= {f"spine{step}": spine[index] for step, index in enumerate(indices, start=1)}
        heads = [n for n, words in enumerate(self.words) if words.word == "head" and not self.is_end(n)]
        if heads:
            line = self.list_path(heads[0])
        else:  # the longest path through the last shoulder node, without arms
            arms = {node for arm in lines[2:] for node in arm} - set(shoulders)
            lines_to_all = [self.list_path(n) for n in range(len(self.nodes))]
            line = max((x for x in lines_to_all if shoulders[-1] in x and not arms & set(x)), key=len)
        above = [node for node in line if node not in shoulders and not self.is_end(node)]
        if above:
            necks = [node for node in above[:-1] if "neck" in self.words[node].word] or above[:-1]
            node_of |= {"head": above[-1]} | ({"neck": necks[0]} if necks else {})
        return node_of


def convert_with_guess(recording: Recording, proposed: MapGuess) -> Conversion:
    """Convert a file to the built-in body with a proposed map. Raises InputError if this fails."""
    if missing := ", ".join(proposed.missing):
        raise InputError(f"joints.{proposed.missing[0]}: not found; add {missing} to the map")
    name = proposed.skeleton.name
    fps = recording.fps or 60.0  # the check of the map does not depend on the rate
    return convert_recording(recording, proposed.skeleton, make_builtin_rest_joints(), name=name, fps=fps)


def format_yaml(proposed: MapGuess, recording: Recording) -> str:
    """Format the map as YAML, with comments that mark guesses and missing joints."""
    skeleton = proposed.skeleton
    lines = [
        f"# Proposed for {recording.path.name} by `memmlp data skeleton guess`.",
        "# Check it with `memmlp data skeleton show` before you use it.",
        f"name: {json.dumps(skeleton.name)}",
        "unit: auto",
        "up: auto",
    ]
    if skeleton.calibration_frame:
        lines.append("calibration_frame: true  # guessed: frame 0 is far from frame 1")
    lines.append("joints:")
    for joint in (JOINTS[index] for chain in CHAINS for index in chain):
        if joint in skeleton.joints:
            comment = "  # guessed from the tree" if joint in proposed.by_tree else ""
            lines.append(f"  {joint}: {json.dumps(skeleton.joints[joint])}{comment}")
        else:
            required = "is required: add it by hand" if joint in proposed.missing else "has no counterpart"
            lines.append(f"  # {joint} {required}.")
    return "\n".join(lines) + "\n"


def write_map(path: Path, text: str) -> None:
    """Write a map to a new file. Raises InputError if the file exists or can't be written."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise InputError(f"--out {path}: file exists; must be a new file") from None
    except OSError as error:
        raise InputError(f"--out {path}: cannot be written ({error.strerror})") from None
