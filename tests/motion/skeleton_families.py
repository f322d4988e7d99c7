"""Skeletons of every shipped map, for Mixamo with nodes that its map leaves out."""

from dataclasses import replace

from bvh_samples import TREES, ZXY, Sample, own_tree, performed, random_turns, tree

from memmlp.motion.formats.bvh import Bvh
from memmlp.motion.formats.recording import END
from memmlp.motion.importing.skeleton_map import load_skeleton
from memmlp.motion.synthetic import synthesize_clip

FINGERS = "{S}HandIndex1 {S}Hand {x}9 0 1; {S}HandIndex2 {S}HandIndex1 {x}4 0 0"
THUMB = "{S}HandThumb1 {S}Hand {x}3 -1 3"
TIPS = "*{S}HandIndex2 {x}3 0 0; *{S}HandThumb1 {x}3 0 2; *{S}Toe{base} 0 0 6"
HANDS = "; ".join(
    part.format(S=side, x=sign, base="Base")
    for side, sign in (("Left", ""), ("Right", "-"))
    for part in (FINGERS, THUMB, TIPS)
)
MORE = {
    "mixamo": "HeadTop_End Head 0 19 6; *HeadTop_End 0 0 0; LeftEye Head 3 8 9; " + HANDS,
    "iclone": "FacialBone Head 0 0 0; JawRoot FacialBone 0 2 3; *JawRoot 0 1 2",
}
"""Nodes that a map leaves out: node, parent, offset in centimetres; * for an end site."""


def family(name: str) -> Sample:
    sample = tree(name) if name in TREES else own_tree(load_skeleton(name))
    for entry in filter(None, MORE.get(name, "").split(";")):
        node, *rest = entry.split()
        offset = [float(number) for number in rest[-3:]]
        if node.startswith("*"):
            sample.ends.append((sample.names.index(node[1:]), offset))
            continue
        sample.names.append(node)
        sample.parents.append(sample.names.index(rest[0]))
        sample.channels.append(ZXY)
        sample.offsets.append(offset)
    return in_order(sample)


def in_order(sample: Sample) -> Sample:
    """Return a skeleton with its joints in the order in which a file has them."""

    def below(joint: int) -> list[int]:
        children = [child for child, parent in enumerate(sample.parents) if parent == joint]
        return [joint, *(node for child in children for node in below(child))]

    order = below(0)
    parts = ([part[old] for old in order] for part in (sample.names, sample.offsets, sample.channels))
    names, offsets, channels = parts
    parents = [order.index(sample.parents[old]) if old else -1 for old in order]
    ends = [(order.index(joint), offset) for joint, offset in sample.ends]
    return replace(sample, names=names, parents=parents, offsets=offsets, ends=ends, channels=channels)


def walking(name: str, turned: bool = False, seconds: float = 2.0) -> Sample:
    """Make a file of a family in which a person walks, its zero pose turned at random or a T-pose."""
    sample = family(name)
    turns = random_turns(sample, 5) if turned else None
    clip = synthesize_clip("walking", 1, seconds=seconds)
    return performed(load_skeleton(name), clip, sample=sample, turns=turns)


def renamed(bvh: Bvh, names: dict[str, str]) -> Bvh:
    new = [names[name.removesuffix(END)] + (END if name.endswith(END) else "") for name in bvh.nodes]
    return replace(bvh, nodes=tuple(new))


def joints(bvh: Bvh) -> tuple[str, ...]:
    return bvh.nodes[: len(bvh.channels)]
