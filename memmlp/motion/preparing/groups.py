"""Groups of dependent clips, such as clips of the same subject, take or session.

Clips of one group always get the same part of a split, and statistics count a group once. Groups come from
patterns, a column file, or both. Two clips share a group if they match the same pattern (`re.search`) with
equal captured text, or if the file gives both the same group. Warnings report clips that may need a common
group.
"""

from __future__ import annotations

import csv
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import digest
from memmlp.motion.preparing.amass_names import strip_archives
from memmlp.motion.preparing.manifest import Manifest

COLUMNS = ("clip", "group")
KEY = "data.split.groups_file"


@dataclass(frozen=True)
class Grouping:
    """The rules that group clips: regular expressions for clip names, and clip name -> its group in the
    column file."""

    patterns: Sequence[str] = ()
    rows: Mapping[str, str] | None = None
    file: Path | str | None = None

    @property
    def digest(self) -> str | None:
        """A digest of the column file's content; None without a file."""
        return None if self.rows is None else digest(sorted(self.rows.items()))

    def check(self, names: Collection[str], files: Iterable[str]) -> None:
        """Raise InputError unless the column file lists every clip of the split (`names`), and only existing
        `files`."""
        if self.rows is None:
            return
        for problem, clips in (
            ("has no row for clip", set(names) - set(self.rows)),
            ("has a row for a clip that is missing below data.root:", set(self.rows) - set(files)),
        ):
            if clips:
                more = f" and {len(clips) - 1} more" if len(clips) > 1 else ""
                raise InputError(f"{KEY}={self.file}: {problem} {min(clips)}{more}")

    def group_clips(self, aliases: Mapping[str, str]) -> list[list[str]]:
        """Group clips. Membership is transitive: overlapping groups are merged. `aliases` has clip name ->
        the name that patterns match and that determines the order in a group. Raises InputError for an
        invalid pattern."""
        try:
            compiled = [re.compile(pattern) for pattern in self.patterns]
        except re.error as error:
            wrong = f"data.split.groups={error.pattern!r}"
            raise InputError(f"{wrong}: not a regular expression ({error})") from error
        order = sorted(aliases, key=lambda name: aliases[name])
        parents: dict[Any, Any] = {}
        for name in order:
            for index, pattern in enumerate(compiled):
                if match := pattern.search(aliases[name]):
                    parents[find_root(parents, name)] = find_root(parents, (index, match.groups()))
            if self.rows and name in self.rows:
                parents[find_root(parents, name)] = find_root(parents, (KEY, self.rows[name]))
        groups: dict[object, list[str]] = {}
        for name in order:
            groups.setdefault(find_root(parents, name), []).append(name)
        return list(groups.values())

    def name_groups(self, aliases: Mapping[str, str]) -> dict[str, str]:
        """Map each clip to its group's name: the name in the column file, or else the group's first clip."""
        rows = self.rows or {}
        return {name: rows.get(group[0], group[0]) for group in self.group_clips(aliases) for name in group}


def read_groups(file: Path | str) -> dict[str, str]:
    """Read a column file: CSV with the columns `clip` (paths below the data folder, with or without `.npz`)
    and `group`. Other columns are ignored. Raises InputError if the file can't be read or has an invalid
    line."""
    try:
        with open(file, encoding="utf-8-sig", newline="") as stream:
            table = csv.DictReader(stream)
            columns = table.fieldnames or ()
            rows = [(table.line_num, row) for row in table]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{KEY}={file}: cannot be read as CSV ({error})") from error
    if missing := [name for name in COLUMNS if name not in columns]:
        expected = "the first line must have the columns clip and group"
        raise InputError(f"{KEY}={file}: has no column {missing[0]}; {expected}")
    groups: dict[str, str] = {}
    for line, row in rows:
        clip, group = ((row[name] or "").strip() for name in COLUMNS)
        clip = clip.removeprefix("./").removesuffix(".npz")
        if not clip or not group:
            raise InputError(f"{KEY}={file}: line {line} lacks a clip or a group")
        if groups.setdefault(clip, group) != group:
            raise InputError(f"{KEY}={file}: line {line} gives {clip} a second group")
    return groups


def find_root(parents: dict[Any, Any], node: Any) -> Any:
    """Find the root of a node in a union-find forest (node -> parent). The path is shortened."""
    while parents.setdefault(node, node) != node:
        parents[node] = parents[parents[node]]
        node = parents[node]
    return node


# Warnings


def describe_divided_folders(manifest: Manifest) -> str:
    """Describe folders with ungrouped clips in both training and test; empty if there are none. Such a folder
    often belongs to one person or session, unless it contains all clips of its source. Published lists are
    not checked."""
    if manifest.split.get("kind") == "lists":
        return ""
    records = {clip.name: clip for clip in manifest.clips}
    folders: list[tuple[str, int]] = []
    for prefix, split, names in _split_by_source(manifest.split, records):
        held = Counter(folder for name in names for folder in _list_folders(name))
        parts: dict[str, list[str]] = defaultdict(list)
        for name in names:
            clip = records[prefix + name]
            if clip.group == clip.name and not _matches_pattern(split, name):
                inner, *above = _list_folders(name)
                # If each take has its own folder, the parent folder is the person's.
                parts[next((one for one in (inner, *above) if held[one] > 1), inner)].append(clip.split)
        folders += [
            (prefix + folder, splits.count("test"))
            for folder, splits in parts.items()
            if held[folder] < len(names) and {"train", "test"} <= set(splits)
        ]
    if not folders:
        return ""
    count = sum(count for _, count in folders)
    tested = f"{count} test clips share no group with other clips (data.split.groups)"
    more = f" and {len(folders) - 1} more" if len(folders) > 1 else ""
    return f"{tested}, but training has clips of the same folders ({folders[0][0] or 'the top folder'}{more})"


def describe_unmatched_patterns(split: Mapping[str, Any], names: Collection[str]) -> str:
    """Describe group patterns of a split (`Split.describe`) that match no clip; empty if at least one
    matches."""
    remarks = []
    for prefix, own, below in _split_by_source(split, names):
        patterns = own.get("groups", ())
        if patterns and not any(_matches_pattern(own, name) for name in below):
            remarks.append(
                f"{prefix.replace('/', ': ')}none of the {len(patterns)} patterns of data.split.groups "
                f"matches a clip's name (the first pattern is {patterns[0]}). So each clip counts as "
                "independent, and clips of one person may be in training and in test; choose patterns for "
                "other collections with data/grouping@data.split=NAME, or list the person of each clip in "
                "data.split.groups_file"
            )
    return "; ".join(remarks)


def _split_by_source(
    split: Mapping[str, Any], names: Iterable[str]
) -> Iterator[tuple[str, Mapping[str, Any], list[str]]]:
    """Yield each source's name prefix, its split settings, and its clip names without the prefix."""
    sources = {f"{source}/": own for source, own in split.get("sources", {}).items()}
    for prefix, own in (sources or {"": split}).items():
        yield prefix, own, [name.removeprefix(prefix) for name in names if name.startswith(prefix)]


def _matches_pattern(split: Mapping[str, Any], name: str) -> bool:
    return any(re.search(pattern, strip_archives(name)) for pattern in split.get("groups", ()))


def _list_folders(name: str) -> list[str]:
    """Return all folders above a clip, innermost first; [""] for a clip in the top folder."""
    folders = name.split("/")[:-1]
    return ["/".join(folders[:depth]) for depth in range(len(folders), 0, -1)] or [""]
