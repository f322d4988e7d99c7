"""A file's tree as limbs: two legs, two arms, a trunk and a head, found from how the bones branch.

Names are not used here. Legs and arms are the two pairs of long chains whose bones have similar lengths, and
a leg is longer than an arm.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.formats.bvh import END
from memmlp.motion.importing.motion_file import MotionFile

Chains = tuple[tuple[int, ...], tuple[int, ...]]

FRAMES = 200  # of a file, evenly spread, that are looked at
PAIRS = 50  # of limbs that are alike, the longest, among which legs and arms are looked for
ALIKE = 0.3  # by how much of its length a bone may differ from that on the other side
NEARLY = 0.85  # of the best place for a knee or elbow: how good another is that counts as well
SLACK = 0.05  # of a limb's longest bone, by which any may differ as well


@dataclass(frozen=True)
class Tree:
    """A recording's nodes.

    Attributes:
        nodes: the nodes' names.
        parents: the index of each node's parent; -1 for the root.
        positions: positions (F, nodes, 3) in some of the frames, in the file's unit and axes.
    """

    nodes: tuple[str, ...]
    parents: tuple[int, ...]
    positions: np.ndarray

    @cached_property
    def lengths(self) -> np.ndarray:
        """The median distance (nodes,) of each node from its parent; 0 for the root."""
        bones = self.positions[:, 1:] - self.positions[:, list(self.parents[1:])]
        return np.concatenate([[0.0], np.median(np.linalg.norm(bones, axis=-1), axis=0)])

    @cached_property
    def children(self) -> list[list[int]]:
        """The child nodes of each node."""
        children: list[list[int]] = [[] for _ in self.nodes]
        for child, parent in enumerate(self.parents):
            if parent >= 0:
                children[parent].append(child)
        return children

    def line(self, node: int) -> list[int]:
        """Return the nodes from the root to a node."""
        line = [node]
        while self.parents[line[0]] >= 0:
            line.insert(0, self.parents[line[0]])
        return line

    def below(self, node: int) -> set[int]:
        """Return a node and all nodes below it."""
        inside = {node}
        for other, parent in enumerate(self.parents):
            if parent in inside:
                inside.add(other)
        return inside

    def is_end(self, node: int) -> bool:
        """Return whether a node is an end site."""
        return self.nodes[node].endswith(END)


def read_tree(recording: MotionFile, calibration_frame: bool) -> Tree:
    """Return a recording's tree with the positions of evenly spread frames."""
    positions = recording.kinematics()[1][int(calibration_frame and len(recording) > 1) :]
    frames = np.unique(np.linspace(0, len(positions) - 1, FRAMES).astype(int))
    return Tree(recording.nodes, recording.node_parents, positions[frames])


class Pair(NamedTuple):
    """Two limbs that are alike.

    Attributes:
        branch: the node from which they leave.
        chains: the nodes of each limb, from the one below `branch` to the tip of its longest branch.
        size: length of the upper and the lower half of a limb together, averaged over both limbs.
    """

    branch: int
    chains: Chains
    size: float


@dataclass(frozen=True)
class LimbNodes:
    """A person's limbs as nodes.

    Attributes:
        legs: the pair of legs; arms: the pair of arms.
        trunk: nodes from the pelvis to the one from which the arms leave.
        head: nodes after these to the tip of the head; the last one may be an end site.
    """

    legs: Pair
    arms: Pair
    trunk: tuple[int, ...]
    head: tuple[int, ...]


def find_limbs(path: object, tree: Tree, head: int | None = None) -> LimbNodes:
    """Find the limbs of a tree.

    Args:
        path: the file, for messages.
        tree: the nodes.
        head: the node of the head, if it is known by its name.

    Raises:
        InputError: if the tree does not have two arms and two legs, or has nothing between the arms.
    """
    reach = _reach(tree)
    pairs = sorted(_pairs(tree, reach), key=lambda pair: -pair.size)[:PAIRS]
    found = next((two for two in combinations(pairs, 2) if _apart(tree, *two)), None)
    if found is None:
        wrong = f"{len(pairs)} pairs of limbs in the tree of {len(tree.nodes)} nodes"
        raise InputError(f"{path}: {wrong}; allowed: a person's skeleton with two legs and two arms")
    legs, arms = found
    chest = tree.line(arms.branch)
    shared = [node for node in tree.line(legs.branch) if node in chest]
    up = _upwards(tree, reach, arms, shared[-1], head)
    if not up:
        wrong = f"nothing between the arms at {tree.nodes[arms.branch]} that could be a head"
        raise InputError(f"{path}: {wrong}; allowed: a skeleton with a head")
    return LimbNodes(legs, arms, tuple(chest[chest.index(shared[-1]) :]), tuple(up))


def _reach(tree: Tree) -> np.ndarray:
    """Return the length (nodes,) of the longest path down from each node."""
    lengths, reach = tree.lengths, np.zeros(len(tree.nodes))
    for node in reversed(range(1, len(tree.nodes))):
        parent = tree.parents[node]
        reach[parent] = max(reach[parent], reach[node] + lengths[node])
    return reach


def _longest(tree: Tree, reach: np.ndarray, node: int) -> list[int]:
    """Return the nodes of the longest path down from `node`, which is included."""
    chain, lengths = [node], tree.lengths
    while children := tree.children[chain[-1]]:
        chain.append(max(children, key=lambda child: reach[child] + lengths[child]))
    return chain


def _pairs(tree: Tree, reach: np.ndarray) -> Iterator[Pair]:
    """Yield all pairs of chains that leave from the same node and are alike."""
    for branch in range(len(tree.nodes)):
        children = [child for child in tree.children[branch] if not tree.is_end(child)]
        chains = [tuple(_longest(tree, reach, child)) for child in children]
        for one, other in combinations([chain for chain in chains if len(chain) > 2], 2):
            if _alike(tree, (one, other)):
                yield Pair(branch, (one, other), _size(tree, (one, other)))


def _alike(tree: Tree, chains: Chains) -> bool:
    """Return whether the bones of two chains have similar lengths, down to ankle or wrist."""
    count = middle(tree, chains) + 2
    a, b = (tree.lengths[list(chain[:count])] for chain in chains)
    longer = np.maximum(a, b)
    return bool((np.abs(a - b) <= ALIKE * longer + SLACK * longer.max()).all())


def middle(tree: Tree, chains: Chains) -> int:
    """Return the index in a pair's chains of the knees or elbows: between the two longest bones.

    If several places are nearly as good, the last one is taken: a collar-bone may be as long as a forearm,
    but a hand is not.
    """
    count = min(map(len, chains))
    lengths = np.mean([tree.lengths[list(chain[:count])] for chain in chains], axis=0)
    shorter = np.minimum(lengths[1:-1], lengths[2:])
    return 1 + int(np.flatnonzero(shorter >= NEARLY * shorter.max())[-1])


def _size(tree: Tree, chains: Chains) -> float:
    """Return the length of a limb from hip to ankle or from shoulder to wrist, averaged over both limbs."""
    joint = middle(tree, chains)
    return float(sum(tree.lengths[chain[joint]] + tree.lengths[chain[joint + 1]] for chain in chains)) / 2


def _apart(tree: Tree, one: Pair, other: Pair) -> bool:
    """Return whether no limb of two pairs is a part of another."""
    inside = [tree.below(chain[0]) for pair in (one, other) for chain in pair.chains]
    return not any(a & b for a, b in combinations(inside, 2))


def _upwards(tree: Tree, reach: np.ndarray, arms: Pair, pelvis: int, head: int | None) -> list[int]:
    """Return the nodes from above the arms' branch to the tip of the head."""
    taken = {chain[0] for chain in arms.chains}
    line = [] if head is None else tree.line(head)
    if head is not None and arms.branch in line[:-1] and not taken & set(line):
        return line[line.index(arms.branch) + 1 :] + _longest(tree, reach, head)[1:]
    others = [child for child in tree.children[arms.branch] if child not in taken]
    if arms.branch == pelvis or not others:
        return []
    best = max(others, key=lambda child: reach[child] + tree.lengths[child])
    return _longest(tree, reach, best)
