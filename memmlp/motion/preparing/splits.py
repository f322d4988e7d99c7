"""Splits, which assign clip names to train, val, test or nothing.

A clip's name is its path below the data root without suffix, `/`-separated. Clips that `groups` (a list of
regular expressions) tie together are never divided: two clips that match the same pattern anywhere
(`re.search`), with the same captured groups, get the same part. Fractions count groups, and a clip that no
pattern matches is a group of its own. Nothing depends on the order of the names: groups are ranked by a hash
of seed and name, so a clip that is added later moves few others.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from memmlp.common.errors import InputError

PARTS = ("train", "val", "test")
PHASES = ("train", "test")  # the parts for which there are published lists

S2_TRAIN = (
    "CMU", "MPI_Limits", "TotalCapture", "Eyes_Japan_Dataset", "KIT", "BioMotionLab_NTroje", "BMLmovi",
    "EKUT", "ACCAD", "MPI_mosh", "SFU", "MPI_HDM05",
)  # fmt: skip
S2_TEST = ("HumanEva", "Transitions_mocap")
# Later AMASS downloads renamed some subsets: new name -> the name that the protocols use, in lower case.
RENAMED = {
    "bmlrub": "biomotionlab_ntroje",
    "eyesjapandataset": "eyes_japan_dataset",
    "hdm05": "mpi_hdm05",
    "mosh": "mpi_mosh",
    "poseprior": "mpi_limits",
    "transitions": "transitions_mocap",
}


@dataclass(frozen=True)
class Assignment:
    """What a split decided.

    Attributes:
        parts: clip name -> "train", "val", "test", or None for a clip that is left out.
        missing: entries of the split (list entries, subsets) that no clip's name fits.
    """

    parts: Mapping[str, str | None]
    missing: tuple[str, ...] = ()


class Split(Protocol):
    """The split slot's interface."""

    def assign(self, names: Sequence[str]) -> Assignment:
        """Return the part of every name; raises InputError if the split is impossible."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return everything that determines `assign`, ready for JSON, without a path of this machine."""
        ...

    @property
    def groups(self) -> Sequence[str]:
        """Patterns of clips that belong together."""
        ...


@dataclass(frozen=True)
class SeededSplit:
    """A random split with a seed.

    Args:
        test: fraction of the groups (of the clips, without `groups`) for test; 0 leaves it empty.
        val: fraction of the groups for validation; 0 leaves it empty.
        seed: seed of the order in which groups are taken.
        groups: patterns of clips that stay together.
    """

    test: float = 0.1
    val: float = 0.1
    seed: int = 0
    groups: Sequence[str] = ()

    def __post_init__(self) -> None:
        _check_fractions(test=self.test, val=self.val)

    def assign(self, names: Sequence[str]) -> Assignment:
        return Assignment(_divide(names, {"test": self.test, "val": self.val}, self.seed, self.groups))

    def describe(self) -> dict[str, Any]:
        return {"kind": "seeded", "test": self.test, **_carving(self)}


@dataclass(frozen=True)
class ListSplit:
    """Published lists (AvatarPoser, AGRoL): FOLDER/SUBSET/train_split.txt and test_split.txt.

    A line is the relative path of an npz; blank lines, CRLF, a leading `./` and whatever stands before the
    subset's own folder are accepted. Clips in no list are left out.

    Args:
        folder: where the user keeps the lists.
        val: fraction of train's groups that becomes the validation part.
        seed: seed of the validation part.
        groups: patterns of clips that stay together in the validation part.
    """

    folder: Path
    val: float = 0.05
    seed: int = 0
    groups: Sequence[str] = ()
    entries: Mapping[str, str] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        _check_fractions(val=self.val)
        object.__setattr__(self, "entries", _read_lists(Path(self.folder)))

    def assign(self, names: Sequence[str]) -> Assignment:
        listed = {name: self.entries.get(name) for name in names}
        missing = tuple(sorted(set(self.entries) - set(names)))
        return Assignment(_carve_val(listed, self.val, self.seed, self.groups), missing)

    def describe(self) -> dict[str, Any]:
        lists = hashlib.sha256(json.dumps(sorted(self.entries.items())).encode()).hexdigest()
        return {"kind": "lists", "lists_sha256": lists, **_carving(self)}


@dataclass(frozen=True)
class SubsetSplit:
    """A split by top-level folder, in any letter case and under AMASS' old or new name.

    Clips in other folders are left out.

    Args:
        train: names of the training subsets.
        test: names of the test subsets.
        val: fraction of train's groups that becomes the validation part.
        seed: seed of the validation part.
        groups: patterns of clips that stay together in the validation part.
    """

    train: Sequence[str]
    test: Sequence[str]
    val: float = 0.05
    seed: int = 0
    groups: Sequence[str] = ()

    def __post_init__(self) -> None:
        _check_fractions(val=self.val)
        both = {_subset(name) for name in self.train} & {_subset(name) for name in self.test}
        if both:
            raise InputError(f"data.split: subsets {', '.join(sorted(both))} are both in train and in test")

    def assign(self, names: Sequence[str]) -> Assignment:
        phase = {_subset(name): part for part in PHASES for name in getattr(self, part)}
        parts = {name: phase.get(_subset(name)) for name in names}
        present = {_subset(name) for name in names}
        missing = tuple(name for name in (*self.train, *self.test) if _subset(name) not in present)
        return Assignment(_carve_val(parts, self.val, self.seed, self.groups), missing)

    def describe(self) -> dict[str, Any]:
        return {"kind": "subsets", "train": list(self.train), "test": list(self.test), **_carving(self)}


def group_names(names: Iterable[str], patterns: Sequence[str]) -> dict[str, str]:
    """Map each clip's name to its group's: the first name in the group, its own for a clip alone.

    Clips of one group are not replications of each other: two dancers of one recording, for example.

    Raises:
        InputError: if a pattern is no regular expression.
    """
    return {name: group[0] for group in _grouped(names, patterns) for name in group}


def _carving(split: SeededSplit | ListSplit | SubsetSplit) -> dict[str, Any]:
    """Return the settings that every split has."""
    return {"val": split.val, "seed": split.seed, "groups": list(split.groups)}


def _check_fractions(**fractions: float) -> None:
    for key, value in fractions.items():
        if not 0 <= value < 1:
            raise InputError(f"data.{key}: {value} is no fraction; allowed: 0 <= {key} < 1")
    if sum(fractions.values()) >= 1:
        raise InputError(f"data.{', data.'.join(fractions)}: they add up to 1 or more; leave some to train")


def _carve_val(
    parts: Mapping[str, str | None], val: float, seed: int, groups: Sequence[str]
) -> dict[str, str | None]:
    """Return the parts with some of train's groups moved to "val"."""
    train = [name for name, part in parts.items() if part == "train"]
    if not train:
        raise InputError("data.split: no clip of its train part is below data.root; is it the right root?")
    return {**parts, **_divide(train, {"val": val}, seed, groups)}


def _divide(
    names: Sequence[str], fractions: Mapping[str, float], seed: int, groups: Sequence[str]
) -> dict[str, str]:
    """Map names to parts: the first groups in a seeded order fill those of `fractions`, the rest train."""
    ranked = sorted(_grouped(names, groups), key=lambda group: _rank(group[0], seed))
    parts = {name: "train" for name in names}
    start = 0
    for part, count in _counts(len(ranked), fractions).items():
        for group in ranked[start : start + count]:
            parts.update(dict.fromkeys(group, part))
        start += count
    return parts


def _counts(total: int, fractions: Mapping[str, float]) -> dict[str, int]:
    """Return how many groups each part gets: its rounded share, at least one, leaving one for train."""
    counts = {part: max(1, round(share * total)) if share > 0 else 0 for part, share in fractions.items()}
    needed = 1 + sum(count > 0 for count in counts.values())
    if total < needed:
        wanted = ", ".join(["train", *(part for part, count in counts.items() if count)])
        raise InputError(
            f"data.split: {wanted} need at least {needed} clips or groups, and there are {total}; "
            "add clips, loosen data.groups or set a fraction to 0"
        )
    while sum(counts.values()) >= total:
        counts[max(counts, key=lambda part: counts[part])] -= 1
    return counts


def _rank(name: str, seed: int) -> str:
    return hashlib.sha256(json.dumps([seed, name]).encode()).hexdigest()


def _grouped(names: Iterable[str], patterns: Sequence[str]) -> list[list[str]]:
    """Return the names in groups, each sorted; ties are transitive (union-find over names and ties)."""
    try:
        compiled = [re.compile(pattern) for pattern in patterns]
    except re.error as error:
        raise InputError(f"data.groups: {error.pattern!r} is no regular expression ({error})") from error
    parent: dict[object, object] = {}
    groups: dict[object, list[str]] = {}
    for name in sorted(names):
        for index, pattern in enumerate(compiled):
            if match := pattern.search(name):
                parent[_find(parent, name)] = _find(parent, (index, match.groups()))
    for name in sorted(names):
        groups.setdefault(_find(parent, name), []).append(name)
    return list(groups.values())


def _find(parent: dict[object, object], node: object) -> object:
    """Return the root of a node, halving the path on the way."""
    while parent.setdefault(node, node) != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


def _subset(name: str) -> str:
    """Return the subset of a clip's or a subset's name, in lower case and under its old name."""
    top = name.split("/")[0].lower()
    return RENAMED.get(top, top)


def _read_lists(folder: Path) -> dict[str, str]:
    """Map clip names to "train" or "test" by all lists below a folder."""
    files = {phase: sorted(folder.rglob(f"{phase}_split.txt")) for phase in PHASES}
    if not files["train"]:
        raise InputError(f"data.split: no SUBSET/train_split.txt below {folder}")
    entries: dict[str, str] = {}
    for phase in PHASES:
        for file in files[phase]:
            for name in _read_list(file):
                if entries.setdefault(name, phase) != phase:
                    raise InputError(f"{file}: {name} is both in a train and in a test list")
    return entries


def _read_list(file: Path) -> Iterator[str]:
    """Yield the clip names of one list; a path counts from the folder that is named like the list's own."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: not a readable list ({error})") from error
    for line in filter(None, map(str.strip, lines)):
        steps = [step for step in line.removesuffix(".npz").split("/") if step not in ("", ".")]
        subset = file.parent.name
        yield "/".join(steps[steps.index(subset) :] if subset in steps else steps)
