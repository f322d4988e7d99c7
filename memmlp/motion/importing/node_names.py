"""Names of a file's nodes: the namespace before them, spellings that mean the same, sides and words."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from itertools import takewhile
from typing import NamedTuple

from memmlp.motion.formats.bvh import END

SIDES = {"left": "left", "l": "left", "lf": "left", "right": "right", "r": "right", "rt": "right"}
SEPARATORS = re.compile(r"[\W_]+")
TOKENS = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
GLUED = re.compile(r"(left|right|l|r)(.+)")  # leftupleg, lfemur


class NodeWords(NamedTuple):
    """What a node's name says.

    Attributes:
        side: `left`, `right`, or nothing.
        word: the rest without separators, in small letters, such as `upleg`.
    """

    side: str
    word: str


def without_namespace(nodes: Sequence[str]) -> list[str]:
    """Return the names without their common beginning, such as `mixamorig:`, `Character1_` or `m_avg_`.

    Anything that ends in a colon is a namespace, common or not. The names are left whole if two would become
    the same.
    """
    plain = [re.sub(r".*[:|]", "", node) for node in nodes]
    length = _common(plain)
    plain = [name[length:] for name in plain]
    return plain if len(set(plain)) == len(plain) and all(plain) else list(nodes)


def _common(names: Sequence[str]) -> int:
    """Return the length of the names' common beginning, up to a separator or before a capital letter."""
    letters = zip(*(name.removesuffix(END) for name in names), strict=False)
    shared = [each[0] for each in takewhile(lambda each: len(set(each)) == 1, letters)]
    for length in range(len(shared), 0, -1):
        capital = shared[length - 1].islower() and all(name[length : length + 1].isupper() for name in names)
        if SEPARATORS.fullmatch(shared[length - 1]) or capital:
            return length
    return 0


def keys(nodes: Sequence[str]) -> list[str]:
    """Return keys that are equal for all spellings of a name: `Left_hip`, `left_hip` and `x:LeftHip`."""
    return [_key(name) for name in without_namespace(nodes)]


def _key(name: str) -> str:
    stem = name.removesuffix(END)
    return SEPARATORS.sub("", stem).lower() + (END if stem != name else "")


def find_nodes(nodes: Sequence[str], wanted: Sequence[str]) -> dict[str, str] | None:
    """Find the file's node for each wanted name: the exact name, else the only node that is spelt alike.

    Returns None if a wanted name has no node.
    """
    spelt = keys(nodes)
    count = Counter(spelt)
    alike = {key: node for key, node in zip(spelt, nodes, strict=True) if count[key] == 1}
    found = {name: name if name in nodes else alike.get(_key(name)) for name in wanted}
    if None in found.values() or len(set(found.values())) < len(found):
        return None
    return {name: str(node) for name, node in found.items()}


def words(name: str, known: frozenset[str]) -> NodeWords:
    """Return the side and the word of a name without namespace.

    Args:
        name: such as `LeftUpLeg`, `lShldr`, `UpperArm_L`, `thigh.r`, `lfemur`.
        known: known words; the side letter of a name like `lfemur` is split off only if the rest is one of
            them.
    """
    tokens = [token.lower() for token in TOKENS.findall(name.removesuffix(END))]
    sides = {SIDES[token] for token in tokens if token in SIDES}
    if len(sides) == 1:
        return NodeWords(sides.pop(), "".join(token for token in tokens if token not in SIDES))
    word = "".join(tokens)
    glued = GLUED.fullmatch(word)
    if glued and glued[2] in known:
        return NodeWords(SIDES[glued[1]], glued[2])
    return NodeWords("", word)
