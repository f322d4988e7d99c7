"""Splits, which assign clip names to train, val, test or nothing.

A clip's name is its path below the data root without suffix, `/`-separated. Clips that belong together
(`Grouping`) are never divided. Entries of lists and names of subsets match AMASS' clips from any release
(`amass_names`), and patterns of groups see names without the folder of an archive.

Fractions count groups; a clip without ties is a group of its own. Nothing depends on the order of the names:
groups are ranked by a hash of seed and name. So a new clip moves few others, and a smaller `train_fraction`
takes some of the clips of a larger one.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.motion.preparing.amass_names import clip_key, present_subsets, strip_archives, subset
from memmlp.motion.preparing.groups import Grouping

LISTED = ("train", "test")  # the parts for which there are published lists


@dataclass(frozen=True)
class Assignment:
    """The result of a split.

    Attributes:
        parts: clip name -> "train", "val", "test", or None for a clip that is left out.
        groups: clip name -> the name of its group; its own name if it is tied to no other clip.
    """

    parts: Mapping[str, str | None]
    groups: Mapping[str, str]


class Split:
    """The split slot's interface; the defaults suit a split that divides all clips in the folder."""

    listed: Mapping[str, int] = {}
    """The number of the split's entries by subset; empty if it divides all clips in the folder."""

    groups_digest: str | None
    """A digest of the column files that say which clips belong together; None without one."""

    def assign(self, names: Sequence[str]) -> Assignment:
        """Return the part and the group of every name; raises InputError if the split is impossible."""
        raise NotImplementedError

    def describe(self) -> dict[str, Any]:
        """Return everything that determines `assign`, ready for JSON, without paths on this machine."""
        raise NotImplementedError

    def check_groups(self, names: Collection[str], files: Collection[str]) -> None:
        """Check that column files fit the clips to be split and all files (see `Grouping.check`)."""
        raise NotImplementedError

    def limit(self, parts: Mapping[str, str | None], groups: Mapping[str, str]) -> dict[str, str | None]:
        """Return the clips' parts without the clips that the split leaves out of large groups."""
        return dict(parts)

    def missing(self, names: Collection[str]) -> tuple[str, ...]:
        """Return the entries of the split (list entries, subsets) that match none of the names."""
        return ()


@dataclass(frozen=True, kw_only=True)
class GroupedSplit(Split):
    """A split that divides groups of clips in a seeded order; the base of all but MixedSplit.

    Args:
        val: fraction of the groups for validation; 0 leaves it empty.
        seed: seed of the order in which groups are taken.
        groups: patterns of clips that stay together.
        groups_file: column file that says which clips stay together; None for none.
        train_fraction: fraction of train's groups that are used; the others are left out.
    """

    val: float = 0.05
    seed: int = 0
    groups: Sequence[str] = ()
    groups_file: Path | str | None = field(default=None, repr=False)
    train_fraction: float = 1.0

    def __post_init__(self) -> None:
        self._check_fractions(val=self.val)

    def _check_fractions(self, **fractions: float) -> None:
        if not 0 < self.train_fraction <= 1:
            raise InputError(
                f"data.split.train_fraction={self.train_fraction}: must be above 0 and at most 1"
            )
        for key, value in fractions.items():
            if not 0 <= value < 1:
                raise InputError(f"data.split.{key}={value}: must be at least 0 and below 1")
        if sum(fractions.values()) >= 1:
            raise InputError(
                "data.split.test, data.split.val: must add up to less than 1: training needs the rest"
            )

    @cached_property
    def grouping(self) -> Grouping:
        """The rules that tie clips together."""
        return Grouping.of(self.groups, self.groups_file)

    @property
    def groups_digest(self) -> str | None:  # type: ignore[override]
        return self.grouping.digest

    def check_groups(self, names: Collection[str], files: Collection[str]) -> None:
        self.grouping.check(names, files)

    def _description(self) -> dict[str, Any]:
        digest = self.groups_digest
        file = {"groups_file_sha256": digest} if digest else {}
        fewer = {"train_fraction": self.train_fraction} if self.train_fraction < 1 else {}
        return {"val": self.val, "seed": self.seed, "groups": list(self.groups), **file, **fewer}

    def _divide(self, aliases: Mapping[str, str], fractions: Mapping[str, float]) -> dict[str, str | None]:
        """Map clips to parts: the first groups in seeded order fill those of `fractions`, the others train.

        The last groups of train are left out (None), as `train_fraction` says.

        Args:
            aliases: each clip's name -> the name that patterns and the seeded order use.
            fractions: part -> its fraction of the groups.

        Raises:
            InputError: if there are fewer groups than parts.
        """
        ranked = sorted(self.grouping.tie(aliases), key=lambda group: rank(aliases[group[0]], self.seed))
        parts: dict[str, str | None] = dict.fromkeys(aliases, "train")
        start = 0
        for part, count in _counts(len(ranked), fractions).items():
            for group in ranked[start : start + count]:
                parts.update(dict.fromkeys(group, part))
            start += count
        used = max(1, round(self.train_fraction * (len(ranked) - start)))
        for group in ranked[start + used :]:
            parts.update(dict.fromkeys(group, None))
        return parts


def rank(name: str, seed: int) -> str:
    """Return the key by which names are sorted for an order that depends on the seed alone."""
    return hashlib.sha256(json.dumps([seed, name]).encode()).hexdigest()


def _counts(total: int, fractions: Mapping[str, float]) -> dict[str, int]:
    """Return the number of groups of each part: its rounded share, and at least one unless that is 0.

    One group is left for train.
    """
    counts = {part: max(1, round(share * total)) if share > 0 else 0 for part, share in fractions.items()}
    needed = 1 + sum(count > 0 for count in counts.values())
    if total < needed:
        parts = ", ".join(["train", *(part for part, count in counts.items() if count)])
        raise InputError(
            f"data.split: {parts} need at least {needed} clips or groups, but there are {total}; "
            "add clips, loosen data.split.groups or set a fraction to 0"
        )
    while sum(counts.values()) >= total:
        counts[max(counts, key=lambda part: counts[part])] -= 1
    return counts


@dataclass(frozen=True, kw_only=True)
class SeededSplit(GroupedSplit):
    """A random split with a seed.

    Args:
        test: fraction of the groups for test (of the clips, if none are tied); 0 leaves it empty.
        per_group: the largest number of clips of a group in test, and in validation; the others are left out,
            since repetitions of a motion add little information. None for all clips.
    """

    test: float = 0.1
    val: float = 0.1
    per_group: int | None = None

    def __post_init__(self) -> None:
        self._check_fractions(test=self.test, val=self.val)

    def assign(self, names: Sequence[str]) -> Assignment:
        aliases = {name: strip_archives(name) for name in names}
        parts, groups = (
            self._divide(aliases, {"test": self.test, "val": self.val}),
            self.grouping.names(aliases),
        )
        return Assignment(self.limit(parts, groups), groups)

    def limit(self, parts: Mapping[str, str | None], groups: Mapping[str, str]) -> dict[str, str | None]:
        if self.per_group is None:
            return dict(parts)
        held_out: dict[str, list[str]] = defaultdict(list)
        for name in sorted(parts, key=lambda name: rank(name, self.seed)):
            if parts[name] in ("test", "val"):
                held_out[groups[name]].append(name)
        left_out = (name for names in held_out.values() for name in names[self.per_group :])
        return {**parts, **dict.fromkeys(left_out)}

    def describe(self) -> dict[str, Any]:
        most = {"per_group": self.per_group} if self.per_group else {}
        return {"kind": "seeded", "test": self.test, **self._description(), **most}


@dataclass(frozen=True)
class MixedSplit(Split):
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
        for source, own in self._names_by_source(names):
            try:
                found = self.splits[source].assign(own)
            except InputError as error:
                raise InputError(f"data.sources.{source}: {error}") from None
            parts |= {f"{source}/{name}": part for name, part in found.parts.items()}
            groups |= {f"{source}/{name}": f"{source}/{group}" for name, group in found.groups.items()}
        return Assignment(parts, groups)

    def limit(self, parts: Mapping[str, str | None], groups: Mapping[str, str]) -> dict[str, str | None]:
        result: dict[str, str | None] = {}
        for source, own in self._names_by_source(parts):
            full = {name: f"{source}/{name}" for name in own}
            limited = self.splits[source].limit(
                {name: parts[full[name]] for name in own}, {name: groups[full[name]] for name in own}
            )
            result |= {full[name]: part for name, part in limited.items()}
        return result

    def describe(self) -> dict[str, Any]:
        return {"kind": "mixed", "sources": {name: split.describe() for name, split in self.splits.items()}}

    @property
    def groups_digest(self) -> str | None:  # type: ignore[override]
        digests = {name: split.groups_digest for name, split in self.splits.items() if split.groups_digest}
        return hashlib.sha256(json.dumps(digests, sort_keys=True).encode()).hexdigest() if digests else None

    def check_groups(self, names: Collection[str], files: Collection[str]) -> None:
        every = dict(self._names_by_source(files))
        for source, own in self._names_by_source(names):
            self.splits[source].check_groups(own, every[source])

    def _names_by_source(self, names: Iterable[str]) -> Iterator[tuple[str, list[str]]]:
        for source in self.splits:
            yield source, [rest for name in names if (rest := name.removeprefix(f"{source}/")) != name]


class PublishedSplit(GroupedSplit):
    """A split with published training and test parts; a seeded part of training becomes validation."""

    def _carve_validation(self, parts: Mapping[str, str | None], aliases: Mapping[str, str]) -> Assignment:
        """Return the assignment with some of train's groups moved to "val"."""
        train = {name: aliases[name] for name, part in parts.items() if part == "train"}
        if not train:
            raise InputError("data.split: data.root has no clip of its training part; is it the right root?")
        carved = {**parts, **self._divide(train, {"val": self.val})}
        return Assignment(carved, self.grouping.names(aliases))


@dataclass(frozen=True)
class ListSplit(PublishedSplit):
    """Published lists (AvatarPoser, AGRoL): FOLDER/SUBSET/train_split.txt and test_split.txt.

    A line is the relative path of an npz; blank lines, CRLF, a leading `./` and anything before the subset's
    own folder are accepted. An entry means the clip of that name, or else the clip that has that name
    in another release of AMASS. Clips in no list are left out. Patterns of groups see an entry's name,
    so that a list divides every release in the same way.

    Args:
        folder: where the user keeps the lists.
    """

    folder: Path
    entries: Mapping[str, str] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "entries", _read_lists(Path(self.folder)))

    def assign(self, names: Sequence[str]) -> Assignment:
        entries = _match_entries(self.entries, names)
        aliases = {name: entries.get(name, name) for name in names}
        parts = {name: self.entries.get(aliases[name]) for name in names}
        return self._carve_validation(parts, aliases)

    def missing(self, names: Collection[str]) -> tuple[str, ...]:
        return tuple(sorted(set(self.entries) - set(_match_entries(self.entries, names).values())))

    @property
    def listed(self) -> Mapping[str, int]:  # type: ignore[override]
        """The number of the split's entries by subset."""
        return dict(Counter(entry.split("/")[0] for entry in sorted(self.entries)))

    def describe(self) -> dict[str, Any]:
        lists = hashlib.sha256(json.dumps(sorted(self.entries.items())).encode()).hexdigest()
        return {"kind": "lists", "lists_sha256": lists, **self._description()}


@dataclass(frozen=True)
class SubsetSplit(PublishedSplit):
    """A split by top-level folder, in any letter case and under any name that AMASS gave the subset.

    Clips in other folders are left out.

    Args:
        train: names of the training subsets.
        test: names of the test subsets.
    """

    train: Sequence[str]
    test: Sequence[str]

    def __post_init__(self) -> None:
        super().__post_init__()
        if deeper := [name for name in (*self.train, *self.test) if "/" in name]:
            raise InputError(f"data.split: {deeper[0]} must be the name of a folder in data.root, without /")
        both = set(map(subset, self.train)) & set(map(subset, self.test))
        if both:
            raise InputError(f"data.split: subsets {', '.join(sorted(both))} are both in train and in test")

    def assign(self, names: Sequence[str]) -> Assignment:
        part_of = {subset(name): part for part in LISTED for name in getattr(self, part)}
        aliases = {name: strip_archives(name) for name in names}
        parts = {name: part_of.get(subset(name), part_of.get(subset(own))) for name, own in aliases.items()}
        clips = defaultdict(list)
        for name in sorted(name for name, part in parts.items() if part):
            clips[clip_key(name)].append(name)
        _check_one_release(clips.values())
        return self._carve_validation(parts, aliases)

    def missing(self, names: Collection[str]) -> tuple[str, ...]:
        present = present_subsets(names)
        return tuple(name for name in (*self.train, *self.test) if subset(name) not in present)

    @property
    def listed(self) -> Mapping[str, int]:  # type: ignore[override]
        """The number of the split's entries by subset."""
        return dict.fromkeys((*self.train, *self.test), 1)

    def describe(self) -> dict[str, Any]:
        return {
            "kind": "subsets", "train": list(self.train), "test": list(self.test), **self._description()
        }  # fmt: skip


# Published lists


def _match_entries(entries: Collection[str], names: Collection[str]) -> dict[str, str]:
    """Map clips to their entries in a list: by name, else by the name in another release of AMASS."""
    same = {name: name for name in names if name in entries}
    others = {clip_key(entry).lower(): entry for entry in sorted(set(entries) - set(same), reverse=True)}
    files_of = defaultdict(list)
    for name in sorted(set(names) - set(same)):
        if (entry := others.get(clip_key(name).lower())) is not None:
            files_of[entry].append(name)
    _check_one_release(files_of.values())
    return same | {clips[0]: entry for entry, clips in files_of.items()}


def _check_one_release(matches: Iterable[Sequence[str]]) -> None:
    """Raise InputError if several files, from several releases of AMASS, are the same clip."""
    several = [clips for clips in matches if len(clips) > 1]
    if several:
        first, second = several[0][:2]
        raise InputError(
            f"data.root: {len(several)} clips of the split match more than one file, the first {first}.npz "
            f"and {second}.npz; keep one release of AMASS below it"
        )


def _read_lists(folder: Path) -> dict[str, str]:
    """Map clip names to "train" or "test", by all lists below a folder."""
    files = {part: sorted(folder.rglob(f"{part}_split.txt")) for part in LISTED}
    if not files["train"]:
        raise InputError(f"data.split.folder={folder}: no SUBSET/train_split.txt in it")
    for subfolder in sorted({file.parent for part in LISTED for file in files[part]}):
        for part in LISTED:
            if subfolder / f"{part}_split.txt" not in files[part]:
                raise InputError(
                    f"data.split.folder={folder}: {subfolder} lacks {part}_split.txt; "
                    "a subset must have both lists, of which one may be empty"
                )
    entries: dict[str, str] = {}
    for part in LISTED:
        for file in files[part]:
            for name in _read_list(file):
                if entries.setdefault(name, part) != part:
                    raise InputError(f"{file}: {name} is both in a train and in a test list")
    return entries


def _read_list(file: Path) -> Iterator[str]:
    """Yield the clip names of a list; a path begins at the folder that is named like the list's own."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: not a readable list ({error})") from error
    for line in filter(None, map(str.strip, lines)):
        steps = [step for step in line.removesuffix(".npz").split("/") if step not in ("", ".")]
        start = next((i for i, step in enumerate(steps[:-1]) if subset(step) == subset(file.parent.name)), 0)
        yield "/".join(steps[start:])
