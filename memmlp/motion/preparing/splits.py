"""Splits, which assign clip names to train, val, test or nothing.

A clip's name is its path below the data root without suffix, `/`-separated. Clips that belong together
(`Grouping`) are never divided (`memmlp.motion.preparing.grouped_split`). Entries of lists and names of
subsets match AMASS' clips from any release (`memmlp.motion.preparing.amass_names`), and patterns of groups
don't see an archive's folder above that of a subset.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from memmlp.common.errors import InputError
from memmlp.motion.preparing.amass_names import subset, unpacked
from memmlp.motion.preparing.grouped_split import Grouped, check_fractions, rank
from memmlp.motion.preparing.published_lists import PHASES, check_once, entries_of_clips, read_lists

PARTS = ("train", "val", "test")


@dataclass(frozen=True)
class Assignment:
    """The result of a split.

    Attributes:
        parts: clip name -> "train", "val", "test", or None for a clip that is left out.
        groups: clip name -> the name of its group; its own name if it is tied to no other clip.
        missing: entries of the split (list entries, subsets) without a matching clip.
    """

    parts: Mapping[str, str | None]
    groups: Mapping[str, str]
    missing: tuple[str, ...] = ()


class Split(Protocol):
    """The split slot's interface."""

    def assign(self, names: Sequence[str]) -> Assignment:
        """Return the part and the group of every name; raises InputError if the split is impossible."""
        ...

    def limited(self, parts: Mapping[str, str | None], groups: Mapping[str, str]) -> dict[str, str | None]:
        """Return the clips' parts without the clips that the split leaves out of large groups."""
        ...

    def missing(self, names: Collection[str]) -> tuple[str, ...]:
        """Return the entries of the split (list entries, subsets) that match none of the names."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return everything that determines `assign`, ready for JSON, without paths on this machine."""
        ...

    @property
    def listed(self) -> Mapping[str, int]:
        """The number of the split's entries by subset; empty if it divides all clips in the folder."""
        ...

    @property
    def groups_digest(self) -> str | None:
        """A digest of the column files that say which clips belong together; None without one."""
        ...

    def check_groups(self, names: Collection[str], files: Collection[str]) -> None:
        """Check that column files fit the clips to be split and all files (see `Grouping.check`)."""
        ...


@dataclass(frozen=True)
class SeededSplit(Grouped):
    """A random split with a seed.

    Args:
        test: fraction of the groups for test (of the clips, if none are tied); 0 leaves it empty.
        val: fraction of the groups for validation; 0 leaves it empty.
        seed: seed of the order in which groups are taken.
        groups: patterns of clips that stay together.
        groups_file: column file that says which clips stay together; None for none.
        train_fraction: fraction of train's groups that are used; the others are left out.
        per_group: the largest number of clips of a group in test, and in validation; the others are left out,
            since repetitions of a motion tell little more than one of them. None for all clips.
    """

    test: float = 0.1
    val: float = 0.1
    seed: int = 0
    groups: Sequence[str] = ()
    groups_file: Path | str | None = field(default=None, repr=False)
    train_fraction: float = 1.0
    per_group: int | None = None

    def __post_init__(self) -> None:
        check_fractions(self.train_fraction, test=self.test, val=self.val)

    def assign(self, names: Sequence[str]) -> Assignment:
        seen = {name: unpacked(name) for name in names}
        parts, groups = self.divided(seen, {"test": self.test, "val": self.val}), self.grouping.names(seen)
        return Assignment(self.limited(parts, groups), groups)

    def limited(self, parts: Mapping[str, str | None], groups: Mapping[str, str]) -> dict[str, str | None]:
        if self.per_group is None:
            return dict(parts)
        held_out: dict[str, list[str]] = defaultdict(list)
        for name in sorted(parts, key=lambda name: rank(name, self.seed)):
            if parts[name] in ("test", "val"):
                held_out[groups[name]].append(name)
        left_out = (name for names in held_out.values() for name in names[self.per_group :])
        return {**parts, **dict.fromkeys(left_out)}

    def missing(self, names: Collection[str]) -> tuple[str, ...]:
        return ()

    @property
    def listed(self) -> Mapping[str, int]:
        return {}

    def describe(self) -> dict[str, Any]:
        most = {"per_group": self.per_group} if self.per_group else {}
        return {"kind": "seeded", "test": self.test, **self.described(), **most}


@dataclass(frozen=True)
class MixedSplit:
    """Several sources, each split by itself, so that each has all parts.

    A clip's name is the source's name, a `/`, and the clip's name in that source; the source's split sees the
    latter.

    Args:
        splits: source's name -> its split.
    """

    splits: Mapping[str, SeededSplit]

    def assign(self, names: Sequence[str]) -> Assignment:
        parts: dict[str, str | None] = {}
        groups: dict[str, str] = {}
        for source, own in self._own(names):
            try:
                found = self.splits[source].assign(own)
            except InputError as error:
                raise InputError(f"data.sources.{source}: {error}") from None
            parts |= {f"{source}/{name}": part for name, part in found.parts.items()}
            groups |= {f"{source}/{name}": f"{source}/{group}" for name, group in found.groups.items()}
        return Assignment(parts, groups)

    def limited(self, parts: Mapping[str, str | None], groups: Mapping[str, str]) -> dict[str, str | None]:
        found: dict[str, str | None] = {}
        for source, own in self._own(parts):
            whole = {name: f"{source}/{name}" for name in own}
            limited = self.splits[source].limited(
                {name: parts[whole[name]] for name in own}, {name: groups[whole[name]] for name in own}
            )
            found |= {whole[name]: part for name, part in limited.items()}
        return found

    def missing(self, names: Collection[str]) -> tuple[str, ...]:
        return ()

    @property
    def listed(self) -> Mapping[str, int]:
        return {}

    def describe(self) -> dict[str, Any]:
        return {
            "kind": "mixed",
            "sources": {source: split.describe() for source, split in self.splits.items()},
        }

    @property
    def groups_digest(self) -> str | None:
        digests = {
            source: split.groups_digest for source, split in self.splits.items() if split.groups_digest
        }
        return hashlib.sha256(json.dumps(digests, sort_keys=True).encode()).hexdigest() if digests else None

    def check_groups(self, names: Collection[str], files: Collection[str]) -> None:
        every = dict(self._own(files))
        for source, own in self._own(names):
            self.splits[source].check_groups(own, every[source])

    def _own(self, names: Iterable[str]) -> Iterator[tuple[str, list[str]]]:
        """Yield each source with its clips' names in that source."""
        for source in self.splits:
            yield source, [rest for name in names if (rest := name.removeprefix(f"{source}/")) != name]


@dataclass(frozen=True)
class ListSplit(Grouped):
    """Published lists (AvatarPoser, AGRoL): FOLDER/SUBSET/train_split.txt and test_split.txt.

    A line is the relative path of an npz; blank lines, CRLF, a leading `./` and anything before the subset's
    own folder are accepted. An entry stands for the clip of that name, or else for the clip that has that
    name in another release of AMASS. Clips in no list are left out. Patterns of groups see an entry's name,
    so that a list divides every release in the same way.

    Args:
        folder: where the user keeps the lists.
        val: fraction of train's groups that becomes the validation part.
        seed: seed of the validation part.
        groups: patterns of clips that stay together in the validation part.
        groups_file: column file that says which clips stay together; None for none.
        train_fraction: fraction of train's groups that are used; the others are left out.
    """

    folder: Path
    val: float = 0.05
    seed: int = 0
    groups: Sequence[str] = ()
    groups_file: Path | str | None = field(default=None, repr=False)
    train_fraction: float = 1.0
    entries: Mapping[str, str] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_fractions(self.train_fraction, val=self.val)
        object.__setattr__(self, "entries", read_lists(Path(self.folder)))

    def assign(self, names: Sequence[str]) -> Assignment:
        fits = entries_of_clips(self.entries, names)
        seen = {name: fits.get(name, name) for name in names}
        parts = {name: self.entries.get(seen[name]) for name in names}
        missing = tuple(sorted(set(self.entries) - set(fits.values())))
        return _carved(parts, seen, self, missing)

    def missing(self, names: Collection[str]) -> tuple[str, ...]:
        return tuple(sorted(set(self.entries) - set(entries_of_clips(self.entries, names).values())))

    @property
    def listed(self) -> Mapping[str, int]:
        return dict(Counter(entry.split("/")[0] for entry in sorted(self.entries)))

    def describe(self) -> dict[str, Any]:
        lists = hashlib.sha256(json.dumps(sorted(self.entries.items())).encode()).hexdigest()
        return {"kind": "lists", "lists_sha256": lists, **self.described()}


@dataclass(frozen=True)
class SubsetSplit(Grouped):
    """A split by top-level folder, in any letter case and under any name that AMASS gave the subset.

    Clips in other folders are left out.

    Args:
        train: names of the training subsets.
        test: names of the test subsets.
        val: fraction of train's groups that becomes the validation part.
        seed: seed of the validation part.
        groups: patterns of clips that stay together in the validation part.
        groups_file: column file that says which clips stay together; None for none.
        train_fraction: fraction of train's groups that are used; the others are left out.
    """

    train: Sequence[str]
    test: Sequence[str]
    val: float = 0.05
    seed: int = 0
    groups: Sequence[str] = ()
    groups_file: Path | str | None = field(default=None, repr=False)
    train_fraction: float = 1.0

    def __post_init__(self) -> None:
        check_fractions(self.train_fraction, val=self.val)
        if deeper := [name for name in (*self.train, *self.test) if "/" in name]:
            raise InputError(
                f"data.split: {deeper[0]} is no subset; allowed: names of folders below data.root"
            )
        both = set(map(subset, self.train)) & set(map(subset, self.test))
        if both:
            raise InputError(f"data.split: subsets {', '.join(sorted(both))} are both in train and in test")

    def assign(self, names: Sequence[str]) -> Assignment:
        phase = {subset(name): part for part in PHASES for name in getattr(self, part)}
        seen = {name: unpacked(name) for name in names}
        parts = {name: phase.get(subset(name), phase.get(subset(own))) for name, own in seen.items()}
        check_once(name for name, part in parts.items() if part)
        return _carved(parts, seen, self, self.missing(names))

    def missing(self, names: Collection[str]) -> tuple[str, ...]:
        present = {subset(one) for name in names for one in (name, unpacked(name))}
        return tuple(name for name in (*self.train, *self.test) if subset(name) not in present)

    @property
    def listed(self) -> Mapping[str, int]:
        return dict.fromkeys((*self.train, *self.test), 1)

    def describe(self) -> dict[str, Any]:
        return {"kind": "subsets", "train": list(self.train), "test": list(self.test), **self.described()}


def _carved(
    parts: Mapping[str, str | None],
    seen: Mapping[str, str],
    split: ListSplit | SubsetSplit,
    missing: tuple[str, ...],
) -> Assignment:
    """Return the assignment with some of train's groups moved to "val"."""
    train = {name: seen[name] for name, part in parts.items() if part == "train"}
    if not train:
        raise InputError("data.split: no clip of its train part is below data.root; is it the right root?")
    carved = {**parts, **split.divided(train, {"val": split.val})}
    return Assignment(carved, split.grouping.names(seen), missing)
