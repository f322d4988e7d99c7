"""Splits assign clips to train, val or test, or leave clips out.

A clip's name is its path below the data root without suffix, `/`-separated. All clips of a group (`Grouping`)
get the same part. List entries and subset names match clips of any AMASS release (`amass_names`). Group
patterns are matched with names without an archive's folder.

Fractions count groups; a clip without a common group counts as one group. Groups are sorted by a hash of seed
and name. So an additional clip changes the parts of few other clips. A smaller `train_fraction` selects a
subset of the clips of a larger one.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import digest
from memmlp.motion.preparing.amass_names import (
    find_present_subsets,
    make_clip_key,
    normalize_subset,
    strip_archives,
)
from memmlp.motion.preparing.find_clips import find_files
from memmlp.motion.preparing.groups import Grouping, read_groups

LISTED = ("train", "test")  # the parts with published lists


@dataclass(frozen=True)
class Assignment:
    """The result of a split: clip name -> "train", "val", "test", or None (left out); and clip name -> name
    of its group."""

    parts: Mapping[str, str | None]
    groups: Mapping[str, str]


class Split:
    """The interface of the component slot `split`. The defaults suit a split that divides all clips."""

    entry_counts: Mapping[str, int] = {}
    """Subset -> number of the split's entries; empty for a split that divides all clips in the folder."""

    groups_digest: str | None
    """A digest of the column files that group the clips; None without a file."""

    @property
    def copies_give_way(self) -> bool:
        """Whether copies in several parts stay in one of them; otherwise copies are drawn together."""
        return bool(self.entry_counts)

    def assign(self, names: Sequence[str]) -> Assignment:
        """Return the part and the group of each clip. Raises InputError if the split is impossible."""
        raise NotImplementedError

    def describe(self) -> dict[str, Any]:
        """Return all settings that determine `assign`, as JSON values without local paths."""
        raise NotImplementedError

    def check_groups(self, names: Collection[str], files: Collection[str]) -> None:
        """Check that column files, if any, fit the clips to split and all files (see `Grouping.check`)."""

    def limit_group_sizes(
        self, parts: Mapping[str, str | None], groups: Mapping[str, str]
    ) -> dict[str, str | None]:
        """Return the parts after surplus clips of large groups are left out (None)."""
        return dict(parts)

    def find_missing_entries(self, names: Collection[str]) -> tuple[str, ...]:
        """Return the split's entries (list entries, subsets) that match none of the clips."""
        return ()


@dataclass(frozen=True, kw_only=True)
class GroupedSplit(Split):
    """Base class of splits that divide groups of clips (by patterns or a column file) in a seeded order.
    `val` is the fraction of the groups for validation, `train_fraction` that of the training groups that are
    used."""

    val: float = 0.05
    seed: int = 0
    groups: Sequence[str] = ()
    groups_file: Path | str | None = field(default=None, repr=False)
    train_fraction: float = 1.0

    def __post_init__(self) -> None:
        self._check_fractions(self.val)

    def _check_fractions(self, *fractions: float) -> None:
        if self.train_fraction == 0:
            raise InputError("data.split.train_fraction=0: must be above 0, at most 1")
        if sum(fractions) >= 1:
            expected = "the sum must be less than 1, because training gets the rest"
            raise InputError(f"data.split.test, data.split.val: {expected}")

    @cached_property
    def grouping(self) -> Grouping:
        rows = read_groups(self.groups_file) if self.groups_file else None
        return Grouping(self.groups, rows, self.groups_file)

    @property
    def groups_digest(self) -> str | None:  # type: ignore[override]
        return self.grouping.digest

    def check_groups(self, names: Collection[str], files: Collection[str]) -> None:
        self.grouping.check(names, files)

    def _describe_settings(self) -> dict[str, Any]:
        file = {"groups_file_sha256": self.groups_digest} if self.groups_digest else {}
        fewer = {"train_fraction": self.train_fraction} if self.train_fraction < 1 else {}
        return {"val": self.val, "seed": self.seed, "groups": list(self.groups), **file, **fewer}

    def _divide_groups(
        self, aliases: Mapping[str, str], fractions: Mapping[str, float]
    ) -> dict[str, str | None]:
        """Map clips to parts: the first groups in seeded order fill `fractions`' parts, the others train. If
        `train_fraction` is below 1, the last groups of train are left out (None). `aliases` has clip name ->
        the name for patterns and order. Raises InputError if there are fewer groups than parts."""
        groups = self.grouping.group_clips(aliases)
        ranked = sorted(groups, key=lambda group: make_sort_key(aliases[group[0]], self.seed))
        parts: dict[str, str | None] = dict.fromkeys(aliases, "train")
        start = 0
        for part, count in _count_groups(len(ranked), fractions).items():
            for group in ranked[start : start + count]:
                parts.update(dict.fromkeys(group, part))
            start += count
        used = max(1, round(self.train_fraction * (len(ranked) - start)))
        for group in ranked[start + used :]:
            parts.update(dict.fromkeys(group, None))
        return parts


def make_sort_key(name: str, seed: int) -> str:
    """Return a sort key for a name, which gives a random order that depends only on the seed."""
    return digest([seed, name])


def _count_groups(total: int, fractions: Mapping[str, float]) -> dict[str, int]:
    """Return the number of groups of each part: the rounded fraction, but at least 1 unless it is 0; train
    has at least one."""
    counts = {part: max(1, round(share * total)) if share > 0 else 0 for part, share in fractions.items()}
    needed = 1 + sum(count > 0 for count in counts.values())
    if total < needed:
        parts = ", ".join(["train", *(part for part, count in counts.items() if count)])
        wrong = f"{parts} need at least {needed} clips or groups, but there are {total}"
        advice = "add clips, loosen data.split.groups or set a fraction to 0"
        raise InputError(f"data.split: {wrong}; {advice}")
    while sum(counts.values()) >= total:
        counts[max(counts, key=lambda part: counts[part])] -= 1
    return counts


@dataclass(frozen=True, kw_only=True)
class SeededSplit(GroupedSplit):
    """A seeded random split. `test` is the fraction of the groups for test; 0 leaves test empty. `per_group`
    is the maximum number of clips of a group in test and in validation. The other clips are left out, because
    repetitions of a motion add little information. None uses all clips. `divide` is `groups`, or `clips`: the
    clips of a group may be in several parts, as in published lists; the fractions are those of clips, and
    groups count in statistics only."""

    test: float = 0.1
    val: float = 0.1
    per_group: int | None = None
    divide: str = "groups"

    def __post_init__(self) -> None:
        self._check_fractions(self.test, self.val)

    def assign(self, names: Sequence[str]) -> Assignment:
        aliases = {name: strip_archives(name) for name in names}
        units = replace(self, groups=(), groups_file=None) if self.copies_give_way else self
        parts = units._divide_groups(aliases, {"test": self.test, "val": self.val})
        groups = self.grouping.name_groups(aliases)
        return Assignment(self.limit_group_sizes(parts, groups), groups)

    @property
    def copies_give_way(self) -> bool:
        return self.divide == "clips"

    def limit_group_sizes(
        self, parts: Mapping[str, str | None], groups: Mapping[str, str]
    ) -> dict[str, str | None]:
        if self.per_group is None:
            return dict(parts)
        held_out: dict[str, list[str]] = defaultdict(list)
        for name in sorted(parts, key=lambda name: make_sort_key(name, self.seed)):
            if parts[name] in ("test", "val"):
                held_out[groups[name]].append(name)
        left_out = (name for names in held_out.values() for name in names[self.per_group :])
        return {**parts, **dict.fromkeys(left_out)}

    def describe(self) -> dict[str, Any]:
        most = {"per_group": self.per_group} if self.per_group else {}
        divide = {"divide": "clips"} if self.copies_give_way else {}
        return {"kind": "seeded", "test": self.test, **self._describe_settings(), **most, **divide}


@dataclass(frozen=True)
class MixedSplit(Split):
    """A split of several sources, each of which has its own split and all parts. A clip's name is
    "SOURCE/NAME". The source's split gets only NAME."""

    splits: Mapping[str, SeededSplit]

    def assign(self, names: Sequence[str]) -> Assignment:
        parts: dict[str, str | None] = {}
        groups: dict[str, str] = {}
        for source, own in self._split_names_by_source(names):
            try:
                assignment = self.splits[source].assign(own)
            except InputError as error:
                raise InputError(f"data.sources.{source}: {error}") from None
            parts |= {f"{source}/{name}": part for name, part in assignment.parts.items()}
            groups |= {f"{source}/{name}": f"{source}/{group}" for name, group in assignment.groups.items()}
        return Assignment(parts, groups)

    def limit_group_sizes(
        self, parts: Mapping[str, str | None], groups: Mapping[str, str]
    ) -> dict[str, str | None]:
        result: dict[str, str | None] = {}
        for source, own in self._split_names_by_source(parts):
            full = {name: f"{source}/{name}" for name in own}
            limited = self.splits[source].limit_group_sizes(
                {name: parts[full[name]] for name in own}, {name: groups[full[name]] for name in own}
            )
            result |= {full[name]: part for name, part in limited.items()}
        return result

    def describe(self) -> dict[str, Any]:
        return {"kind": "mixed", "sources": {name: split.describe() for name, split in self.splits.items()}}

    @property
    def groups_digest(self) -> str | None:  # type: ignore[override]
        digests = {name: split.groups_digest for name, split in self.splits.items() if split.groups_digest}
        return digest(digests) if digests else None

    def check_groups(self, names: Collection[str], files: Collection[str]) -> None:
        every = dict(self._split_names_by_source(files))
        for source, own in self._split_names_by_source(names):
            self.splits[source].check_groups(own, every[source])

    def _split_names_by_source(self, names: Iterable[str]) -> Iterator[tuple[str, list[str]]]:
        for source in self.splits:
            yield source, [rest for name in names if (rest := name.removeprefix(f"{source}/")) != name]


class PublishedSplit(GroupedSplit):
    """A split with published training and test parts. Validation is a seeded selection from training."""

    def _carve_validation(self, parts: Mapping[str, str | None], aliases: Mapping[str, str]) -> Assignment:
        """Return the assignment after some training groups are moved to "val"."""
        train = {name: aliases[name] for name, part in parts.items() if part == "train"}
        if not train:
            raise InputError("data.split: data.root has no clip of the training part; check data.root")
        carved = {**parts, **self._divide_groups(train, {"val": self.val})}
        return Assignment(carved, self.grouping.name_groups(aliases))


@dataclass(frozen=True)
class ListSplit(PublishedSplit):
    """A split by published lists (AvatarPoser, AGRoL): FOLDER/SUBSET/train_split.txt and test_split.txt. Each
    line is the relative path of an npz file. Blank lines, CRLF, a leading `./` and folders above the subset's
    folder are accepted. An entry matches the clip with this name, or else the corresponding clip of a
    different AMASS release. Clips without an entry are left out. Group patterns are matched with the entries'
    names, so a list divides all releases in the same way."""

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

    def find_missing_entries(self, names: Collection[str]) -> tuple[str, ...]:
        return tuple(sorted(set(self.entries) - set(_match_entries(self.entries, names).values())))

    @property
    def entry_counts(self) -> Mapping[str, int]:  # type: ignore[override]
        """Subset -> number of the split's entries."""
        return dict(Counter(entry.split("/")[0] for entry in sorted(self.entries)))

    def describe(self) -> dict[str, Any]:
        lists = digest(sorted(self.entries.items()))
        return {"kind": "lists", "lists_sha256": lists, **self._describe_settings()}


@dataclass(frozen=True)
class SubsetSplit(PublishedSplit):
    """A split by subsets, which are top-level folders. Letter case and the differing subset names of AMASS
    releases are ignored. Clips in other folders are left out."""

    train: Sequence[str]
    test: Sequence[str]

    def __post_init__(self) -> None:
        super().__post_init__()
        if deeper := [name for name in (*self.train, *self.test) if "/" in name]:
            raise InputError(f"data.split: {deeper[0]} must be the name of a folder in data.root, without /")
        both = set(map(normalize_subset, self.train)) & set(map(normalize_subset, self.test))
        if both:
            raise InputError(f"data.split: subsets {', '.join(sorted(both))} are both in train and in test")

    def assign(self, names: Sequence[str]) -> Assignment:
        part_of = {normalize_subset(name): part for part in LISTED for name in getattr(self, part)}
        aliases = {name: strip_archives(name) for name in names}
        parts = {
            name: part_of.get(normalize_subset(name), part_of.get(normalize_subset(own)))
            for name, own in aliases.items()
        }
        clips = defaultdict(list)
        for name in sorted(name for name, part in parts.items() if part):
            clips[make_clip_key(name)].append(name)
        _check_one_release(clips.values())
        return self._carve_validation(parts, aliases)

    def find_missing_entries(self, names: Collection[str]) -> tuple[str, ...]:
        present = find_present_subsets(names)
        return tuple(name for name in (*self.train, *self.test) if normalize_subset(name) not in present)

    @property
    def entry_counts(self) -> Mapping[str, int]:  # type: ignore[override]
        """Subset -> number of the split's entries."""
        return dict.fromkeys((*self.train, *self.test), 1)

    def describe(self) -> dict[str, Any]:
        lists = {"train": list(self.train), "test": list(self.test)}
        return {"kind": "subsets", **lists, **self._describe_settings()}


# Published lists


def _match_entries(entries: Collection[str], names: Collection[str]) -> dict[str, str]:
    """Map clips to list entries: by the same name, or else by the name in a different AMASS release."""
    same = {name: name for name in names if name in entries}
    others = {make_clip_key(entry).lower(): entry for entry in sorted(set(entries) - set(same), reverse=True)}
    files_of = defaultdict(list)
    for name in sorted(set(names) - set(same)):
        if (entry := others.get(make_clip_key(name).lower())) is not None:
            files_of[entry].append(name)
    _check_one_release(files_of.values())
    return same | {clips[0]: entry for entry, clips in files_of.items()}


def _check_one_release(matches: Iterable[Sequence[str]]) -> None:
    """Raise InputError if files from several AMASS releases are the same clip."""
    several = [clips for clips in matches if len(clips) > 1]
    if several:
        files = " and ".join(f"{name}.npz" for name in several[0][:2])
        raise InputError(
            f"data.root: {len(several)} clips of the split match more than one file, such as {files}; keep "
            "only one AMASS release below data.root"
        )


def _read_lists(folder: Path) -> dict[str, str]:
    found = [folder / file for file in find_files(folder, "_split.txt").files]
    files = {part: [file for file in found if file.name == f"{part}_split.txt"] for part in LISTED}
    if not files["train"]:
        raise InputError(f"data.split.folder={folder}: has no SUBSET/train_split.txt")
    every = [(part, file) for part in LISTED for file in files[part]]
    for subfolder, part in product(sorted({file.parent for _, file in every}), LISTED):
        if subfolder / f"{part}_split.txt" not in files[part]:
            wrong = f"data.split.folder={folder}: {subfolder} lacks {part}_split.txt"
            raise InputError(f"{wrong}; each subset must have both lists; a list may be empty")
    entries: dict[str, str] = {}
    for part, file in every:
        for name in _read_list(file):
            if entries.setdefault(name, part) != part:
                raise InputError(f"{file}: {name} is in both a train list and a test list")
    return entries


def _read_list(file: Path) -> Iterator[str]:
    """Yield the clip names of a list. Folders above the subset's folder are removed from the paths."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: cannot be read as a list ({error})") from error
    subset = normalize_subset(file.parent.name)
    for line in filter(None, map(str.strip, lines)):
        steps = [step for step in line.removesuffix(".npz").split("/") if step not in ("", ".")]
        above = [i for i, step in enumerate(steps[:-1]) if normalize_subset(step) == subset]
        yield "/".join(steps[above[0] if above else 0 :])
