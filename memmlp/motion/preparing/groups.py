"""Groups of clips that are not independent: clips of the same subject, take or session.

Clips of one group are never divided between parts, and statistics count a group once. Patterns, a column
file, or both say which clips belong together: two clips that match the same pattern anywhere (`re.search`)
with the same captured groups are tied, and so are two clips with the same group in the file. Remarks tell the
user of clips that may belong together and are not tied.
"""

from __future__ import annotations

import csv
import hashlib
import json
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.motion.preparing.amass_names import strip_archives
from memmlp.motion.preparing.manifest import Manifest

COLUMNS = ("clip", "group")
KEY = "data.split.groups_file"


@dataclass(frozen=True)
class Grouping:
    """The rules that tie clips together.

    Attributes:
        patterns: regular expressions.
        rows: clip name -> its group in the column file; None without a file.
        file: the column file, for messages.
    """

    patterns: Sequence[str] = ()
    rows: Mapping[str, str] | None = None
    file: Path | None = None

    @classmethod
    def of(cls, patterns: Sequence[str], file: Path | str | None) -> Grouping:
        """Make the grouping of patterns and of a column file, if there is one.

        Raises:
            InputError: if the file can't be read, naming the line that is wrong.
        """
        return cls(tuple(patterns), read_groups(Path(file)) if file else None, Path(file) if file else None)

    @property
    def digest(self) -> str | None:
        """A digest of the column file's content; None without a file."""
        if self.rows is None:
            return None
        return hashlib.sha256(json.dumps(sorted(self.rows.items())).encode()).hexdigest()

    def check(self, names: Collection[str], files: Iterable[str]) -> None:
        """Check that the column file lists every clip to be split, and only clips that have a file.

        Args:
            names: clips to be split.
            files: names of all files, whether they are clips or not.

        Raises:
            InputError: naming the first clip that is missing or unknown.
        """
        if self.rows is None:
            return
        for problem, clips in (
            ("has no row for clip", set(names) - set(self.rows)),
            ("has a row for a clip that is not below data.root:", set(self.rows) - set(files)),
        ):
            if clips:
                more = f" and {len(clips) - 1} more" if len(clips) > 1 else ""
                raise InputError(f"{KEY}={self.file}: {problem} {min(clips)}{more}")

    def tie(self, aliases: Mapping[str, str]) -> list[list[str]]:
        """Return clips in groups; ties are transitive.

        Args:
            aliases: clip name -> the name that patterns, and the order within a group, use.

        Raises:
            InputError: if a pattern is not a regular expression.
        """
        try:
            compiled = [re.compile(pattern) for pattern in self.patterns]
        except re.error as error:
            raise InputError(
                f"data.split.groups={error.pattern!r}: not a regular expression ({error})"
            ) from error
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

    def names(self, aliases: Mapping[str, str]) -> dict[str, str]:
        """Map each clip to its group's name: the column file's, else the name of the group's first clip."""
        rows = self.rows or {}
        return {name: rows.get(group[0], group[0]) for group in self.tie(aliases) for name in group}


def read_groups(file: Path) -> dict[str, str]:
    """Read a column file: CSV with the columns `clip` and `group`; other columns are ignored.

    A clip is named by its path below the data's folder, with or without `.npz`.

    Raises:
        InputError: naming the line that is wrong.
    """
    try:
        with open(file, encoding="utf-8-sig", newline="") as stream:
            table = csv.DictReader(stream)
            columns = table.fieldnames or ()
            rows = [(table.line_num, row) for row in table]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{KEY}={file}: not a readable CSV file ({error})") from error
    if missing := [name for name in COLUMNS if name not in columns]:
        raise InputError(f"{KEY}={file}: no column {missing[0]}; the first line must name clip and group")
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
    """Return the root of a node in a union-find forest (node -> parent), halving the path on the way."""
    while parents.setdefault(node, node) != node:
        parents[node] = parents[parents[node]]
        node = parents[node]
    return node


# Remarks


def divided_remark(manifest: Manifest) -> str:
    """Warn of folders with clips in both training and test that have no common group; empty without any.

    A folder is often a person or a session, unless it holds all clips of its source. Published lists are used
    as they were published.
    """
    if manifest.split.get("kind") == "lists":
        return ""
    records = {clip.name: clip for clip in manifest.clips}
    folders: list[tuple[str, int]] = []
    for prefix, split, names in _by_source(manifest.split, records):
        held = Counter(folder for name in names for folder in _folders(name))
        parts: dict[str, list[str]] = defaultdict(list)
        for name in names:
            clip = records[prefix + name]
            if clip.group == clip.name and not _is_tied(split, name):
                own, *above = _folders(name)
                # Where each take has a folder to itself, the person is the one above.
                parts[next((folder for folder in (own, *above) if held[folder] > 1), own)].append(clip.split)
        folders += [
            (prefix + folder, found.count("test"))
            for folder, found in parts.items()
            if held[folder] < len(names) and {"train", "test"} <= set(found)
        ]
    if not folders:
        return ""
    tested = f"{sum(count for _, count in folders)} test clips are tied to no others (data.split.groups)"
    more = f" and {len(folders) - 1} more" if len(folders) > 1 else ""
    return f"{tested}, but clips of their folders, {folders[0][0] or 'the top one'}{more}, are in training"


def unmatched_patterns_remark(split: Mapping[str, Any], names: Collection[str]) -> str:
    """Warn that a split has patterns of groups and none of them matches a clip; empty otherwise.

    Args:
        split: the split's settings (`Split.describe`).
        names: clips' names.
    """
    remarks = []
    for prefix, own, below in _by_source(split, names):
        patterns = own.get("groups", ())
        if patterns and not any(_is_tied(own, name) for name in below):
            remarks.append(
                f"{prefix.replace('/', ': ')}none of the {len(patterns)} patterns of data.split.groups "
                f"matches a clip's name (the first is {patterns[0]}), so each clip counts as independent, "
                "and clips of one person may be in training and in test; data/grouping@data.split=NAME has "
                "patterns for other collections, and data.split.groups_file can list who is in which clip"
            )
    return "; ".join(remarks)


def _by_source(
    split: Mapping[str, Any], names: Iterable[str]
) -> Iterator[tuple[str, Mapping[str, Any], list[str]]]:
    """Yield the prefix of each source's clips, its split, and its clips' names without the prefix."""
    sources = {f"{source}/": own for source, own in split.get("sources", {}).items()}
    for prefix, own in (sources or {"": split}).items():
        yield prefix, own, [name.removeprefix(prefix) for name in names if name.startswith(prefix)]


def _is_tied(split: Mapping[str, Any], name: str) -> bool:
    return any(re.search(pattern, strip_archives(name)) for pattern in split.get("groups", ()))


def _folders(name: str) -> list[str]:
    """Return the folders that a clip is in, the innermost first; "" at the top."""
    folders = name.split("/")[:-1]
    return ["/".join(folders[:depth]) for depth in range(len(folders), 0, -1)] or [""]
