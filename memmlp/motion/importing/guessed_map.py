"""A skeleton map proposed for a file: from its nodes' names, its tree, and the person who moves in it.

A node's joint is found from its name, if that is a known word and such a joint can be at the node's place in
the tree; otherwise from the lengths of the bones. The map says for each joint how it was found.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from memmlp.common.errors import InputError
from memmlp.motion.body import JOINTS, load_rest_joints
from memmlp.motion.importing.anatomy import CHAINS, unit
from memmlp.motion.importing.axes import with_unit_and_up
from memmlp.motion.importing.calibration_frame import JUMP, MAYBE, first_step
from memmlp.motion.importing.convert import convert
from memmlp.motion.importing.limbs_by_shape import LimbNodes, Pair, Tree, find_limbs, middle, read_tree
from memmlp.motion.importing.motion_file import MotionFile
from memmlp.motion.importing.node_names import NodeWords, without_namespace, words
from memmlp.motion.importing.skeleton_map import SkeletonMap

Found = dict[str, int | None]  # joint -> node; None where no node stands for it

LEG = {  # joint of a leg -> words for it, the clearest first
    "hip": ("thigh", "upleg", "upperleg", "femur", "uplegs", "hip"),
    "knee": ("knee", "shin", "calf", "lowerleg", "lowleg", "loleg", "tibia", "leg"),
    "ankle": ("ankle", "foot"),
    "foot": ("toe", "toes", "toebase", "ball", "foot", "toe0"),
}
ARM = {
    "shoulder": ("upperarm", "uparm", "humerus", "shldr", "arm", "shoulder"),
    "elbow": ("elbow", "forearm", "lowerarm", "lowarm", "loarm", "radius"),
    "wrist": ("wrist", "hand"),
}
COLLAR = ("collar", "clavicle", "thorax", "shoulder", "collarbone")
PELVIS = ("hips", "hip", "pelvis", "root")
KNOWN = frozenset(
    word for each in (*LEG.values(), *ARM.values(), COLLAR) for word in each
) | {"hipjoint", "fingers", "thumb"}  # fmt: skip
TOES, SKULL = 0.02, 0.17  # least lengths of a foot, and of a bone to the tip of the head, to a leg's
FEET, KNEES = 0.3, 0.03  # least mean cosine of the feet to forward, mean sine of the knees, that tell sides


@dataclass(frozen=True)
class Guess:
    """A proposed map.

    Attributes:
        skeleton: the map.
        sources: how each mapped joint was found: `name`, `name and shape`, or what it was guessed from.
        doubts: what can't be decided, or is contradictory, one sentence each.
    """

    skeleton: SkeletonMap
    sources: dict[str, str]
    doubts: tuple[str, ...]


def guess(recording: MotionFile, name: str) -> Guess:
    """Propose a map with the given name for a file.

    Raises:
        InputError: if the tree is not that of a person with two legs, two arms and a head.
    """
    calibration = (jump := first_step(recording)) > JUMP
    tree = read_tree(recording, calibration)
    said = [words(plain, KNOWN) for plain in without_namespace(tree.nodes)]
    limbs = find_limbs(recording.path, tree, _head_by_name(tree, said))
    by_name, by_shape = _by_name(tree, said, limbs), _by_shape(tree, limbs)
    sides, doubts = _sides(tree, said, limbs, by_shape)
    if MAYBE < jump <= JUMP:
        doubts.append("frame 0 is far from frame 1, and may be a calibration pose")
    joints, sources = {}, {}
    for joint in JOINTS:
        side, _, part = joint.rpartition("_")
        key = f"{sides[side, part in LEG]}.{part}" if side else joint
        node, source = _chosen(tree, by_name.get(key), by_shape.get(key))
        if node is None:
            continue
        joints[joint], sources[joint] = tree.nodes[node], source
        other = by_shape.get(key)
        if source == "name" and other is not None:
            doubts.append(f"{joint}: its name says {tree.nodes[node]}, its place {tree.nodes[other]}")
    skeleton = SkeletonMap(name, joints, calibration_frame=calibration)
    return Guess(skeleton, sources, tuple(doubts))


def _chosen(tree: Tree, named: int | None, shaped: int | None) -> tuple[int | None, str]:
    """Return a joint's node, and how it was found."""
    if named is not None:
        return named, "name and shape" if named == shaped else "name"
    if shaped is None:
        return None, ""
    return shaped, "end site" if tree.is_end(shaped) else "guessed from tree and lengths"


# Names


def _head_by_name(tree: Tree, said: Sequence[NodeWords]) -> int | None:
    return next(
        (node for node, word in enumerate(said) if word.word == "head" and not tree.is_end(node)), None
    )


def _by_name(tree: Tree, said: Sequence[NodeWords], limbs: LimbNodes) -> Found:
    """Return the joints that names identify: `0.knee` and `1.knee` for the knees of both chains."""
    found: Found = {}
    for side in (0, 1):
        leg, arm = limbs.legs.chains[side], limbs.arms.chains[side]
        found |= {f"{side}.{part}": node for part, node in _spelt(tree, said, leg, LEG).items()}
        parts = _spelt(tree, said, arm, ARM)
        above = arm[: arm.index(parts["shoulder"])] if "shoulder" in parts else ()
        parts |= _spelt(tree, said, above, {"collar": COLLAR})
        found |= {f"{side}.{part}": node for part, node in parts.items()}
    if said[limbs.trunk[0]].word in PELVIS:
        found["pelvis"] = limbs.trunk[0]
    necks = [node for node in limbs.head if "neck" in said[node].word and not tree.is_end(node)]
    heads = [node for node in limbs.head if said[node].word == "head" and not tree.is_end(node)]
    found |= {"neck": next(iter(necks), None), "head": next(iter(heads), None)}
    return found


def _spelt(
    tree: Tree, said: Sequence[NodeWords], chain: Sequence[int], parts: dict[str, tuple[str, ...]]
) -> dict[str, int]:
    """Return the joints of a chain that its nodes' names identify, each below the one before it."""
    found: dict[str, int] = {}
    rest = [node for node in chain if not tree.is_end(node)]
    for part, spellings in parts.items():
        for spelling in spellings:
            node = next((node for node in rest if said[node].word == spelling), None)
            if node is not None:
                found[part], rest = node, rest[rest.index(node) + 1 :]
                break
    return found


# Tree and lengths


def _by_shape(tree: Tree, limbs: LimbNodes) -> Found:
    """Return the joints that tree and lengths identify, with the keys of `_by_name`."""
    found: Found = {"pelvis": limbs.trunk[0]}
    for side in (0, 1):
        for pair, names in ((limbs.legs, tuple(LEG)), (limbs.arms, tuple(ARM))):
            chain = pair.chains[side]
            joint = middle(tree, pair.chains)
            for name, node in zip(names, chain[joint - 1 : joint + 2], strict=False):
                found[f"{side}.{name}"] = node
        found[f"{side}.foot"] = _toes(tree, limbs.legs, side)
        arm = limbs.arms.chains[side]
        start = middle(tree, limbs.arms.chains) - 1
        found[f"{side}.collar"] = arm[start - 1] if start > 0 else None
    neck, head = _neck_and_head(tree, limbs)
    found |= {"neck": neck, "head": head}
    spine = limbs.trunk[1:]
    picked = np.linspace(0, len(spine) - 1, min(3, len(spine))).astype(int)
    return found | {f"spine{step}": spine[index] for step, index in enumerate(picked, start=1)}


def _toes(tree: Tree, legs: Pair, side: int) -> int | None:
    chain = legs.chains[side]
    after = chain[middle(tree, legs.chains) + 2 :]
    return next((node for node in after if tree.lengths[node] > TOES * legs.size), None)


def _neck_and_head(tree: Tree, limbs: LimbNodes) -> tuple[int | None, int]:
    """Return the nodes of neck and head: the head's node is the last before its tip, or before its eyes."""
    line = [node for node in limbs.head if not tree.is_end(node)] or list(limbs.head)
    branching = next((node for node in line[1:] if len(tree.children[node]) > 1), None)
    if branching is not None:
        return line[0], branching
    tip = len(line) > 2 and tree.lengths[line[-1]] > SKULL * limbs.legs.size
    head = line[-2] if tip else line[-1]
    return (line[0] if line[0] != head else None), head


# Left and right


def _sides(
    tree: Tree, said: Sequence[NodeWords], limbs: LimbNodes, shape: Found
) -> tuple[dict[tuple[str, bool], int], list[str]]:
    """Return which chain is on which side, by (side, whether it is a leg), and the doubts about it."""
    result: dict[tuple[str, bool], int] = {}
    doubts = []
    leg = _left_by_name(said, limbs.legs)
    seen, why = _left_by_motion(tree, shape)
    if seen is None:
        doubts.append(why)
    elif leg is not None and seen != leg:
        doubts.append(f"the names of the legs say another left than {why}")
    if leg is None:
        leg = 0 if seen is None else seen
        source = "LEFT AND RIGHT ARE NOT KNOWN, and may be swapped" if seen is None else f"guessed from {why}"
        doubts.append(f"left and right: {source}")
    arm = _left_by_name(said, limbs.arms)
    beside = _same_side(tree, shape, leg)
    if arm is not None and arm != beside:
        doubts.append("the left arm by its name is on the side of the right leg")
    for left, is_leg in ((leg, True), (beside if arm is None else arm, False)):
        result |= {("left", is_leg): left, ("right", is_leg): 1 - left}
    return result, doubts


def _left_by_name(said: Sequence[NodeWords], pair: Pair) -> int | None:
    """Return which chain is the left one, by the side words of most of its nodes."""
    votes = [
        sum((said[n].side == "left") - (said[n].side == "right") for n in chain) for chain in pair.chains
    ]
    return None if votes[0] * votes[1] >= 0 else int(votes[1] > 0)


def _left_by_motion(tree: Tree, shape: Found) -> tuple[int | None, str]:
    """Return which leg is the left one, as knees bend back and feet point forward, and the evidence."""

    def at(part: str) -> np.ndarray:
        node = shape[part]
        assert node is not None
        return tree.positions[:, node]

    left = unit(at("0.hip") - at("1.hip") + 1e-12)
    forward = np.cross(left, unit(at("head") - at("pelvis") + 1e-12))
    feet = [at(f"{s}.foot") - at(f"{s}.ankle") for s in (0, 1) if shape[f"{s}.foot"] is not None]
    toes = float(np.mean([(unit(foot + 1e-12) * forward).sum(-1).mean() for foot in feet])) if feet else 0.0
    bends = [np.cross(*_bones(at, s)) for s in (0, 1)]
    knees = float(np.mean([(bend * left).sum(-1).mean() for bend in bends]))
    told = [(toes, "the feet", FEET), (knees, "the knees", KNEES)]
    votes = [(int(value < 0), what) for value, what, least in told if abs(value) > least]
    if len({vote for vote, _ in votes}) == 1:
        return votes[0][0], " and ".join(what for _, what in votes)
    wrong = "contradict each other" if votes else "don't show"
    return None, f"feet and knees {wrong} which way the person faces"


def _bones(at: Callable[[str], np.ndarray], side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions (F, 3) of thigh and shin."""
    hip, knee, ankle = (at(f"{side}.{part}") for part in ("hip", "knee", "ankle"))
    return unit(knee - hip + 1e-12), unit(ankle - knee + 1e-12)


def _same_side(tree: Tree, shape: Found, leg: int) -> int:
    """Return which arm is on the side of a leg."""
    hips, shoulders = (
        tree.positions[:, shape[f"0.{part}"]] - tree.positions[:, shape[f"1.{part}"]]
        for part in ("hip", "shoulder")
    )
    return leg if (hips * shoulders).sum(-1).mean() > 0 else 1 - leg


# The proposal on paper, and whether it holds


def check(recording: MotionFile, proposed: Guess, body: str = "builtin") -> tuple[str, tuple[str, ...]]:
    """Import a file with a proposed map; return the stance from which it was read, and the faults.

    Raises:
        InputError: if the file can't be imported with this map.
    """
    done = convert(recording, proposed.skeleton, load_rest_joints(body), name=proposed.skeleton.name)
    return done.stance_words, done.fidelity.faults


def as_yaml(proposed: Guess, recording: MotionFile) -> str:
    """Return the map as YAML, with comments about what is certain and what is guessed."""
    skeleton = proposed.skeleton
    guessed = [joint for joint, source in proposed.sources.items() if "name" not in source]
    lines = [
        f"# Proposed for {recording.path.name} by `memmlp data skeleton guess`.",
        "# Look at it (`memmlp data skeleton show`) before you use it.",
        f"# By name: {len(skeleton.joints) - len(guessed)} joints; without: {', '.join(guessed) or 'none'}.",
        *(f"# In doubt: {doubt}." for doubt in proposed.doubts),
        f"name: {_scalar(skeleton.name)}",
        *_axes_lines(recording, skeleton),
    ]
    if skeleton.calibration_frame:
        lines.append("calibration_frame: true  # guessed: frame 0 is far from frame 1")
    lines.append("joints:")
    for joint in (JOINTS[index] for chain in CHAINS for index in chain):
        if joint in skeleton.joints:
            source = proposed.sources[joint]
            comment = "" if "name" in source else f"  # {source}"
            lines.append(f"  {joint}: {_scalar(skeleton.joints[joint])}{comment}")
        else:
            lines.append(f"  # {joint} has no counterpart.")
    return "\n".join(lines) + "\n"


def _axes_lines(recording: MotionFile, skeleton: SkeletonMap) -> Iterator[str]:
    """Yield the lines of unit and up axis: found in each file, with this file's values as comments."""
    try:
        settled = with_unit_and_up(recording, skeleton)
        yield f"unit: auto  # in this file {settled.unit:.4g} m"
        yield f"up: auto  # in this file {settled.up}"
    except InputError as error:
        yield f"# In doubt: {str(error).removeprefix(f'{recording.path}: ').split(';')[0]}."
        yield from ("unit: auto", "up: auto")


def _scalar(text: str) -> str:
    """Return a text as a YAML scalar that is read back as text."""
    plain = yaml.safe_dump(text, width=1000, allow_unicode=True).splitlines()[0]
    return plain if yaml.safe_load(plain) == text else json.dumps(text)


def write_map(path: Path, text: str) -> None:
    """Write a map to a new file. Raises InputError if there is a file already, or it can't be written."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise InputError(f"--out {path}: a file is there already; allowed: a new file") from None
    except OSError as error:
        raise InputError(f"--out {path}: {error.strerror}; allowed: a new file") from None
