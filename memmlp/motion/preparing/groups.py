"""Groups of clips that are not independent: clips of the same subject, take or session.

Clips of one group are never divided between parts, and statistics count a group once. Patterns, a column
file, or both say which clips belong together: two clips that match the same pattern anywhere (`re.search`)
with the same captured groups are tied, and so are two clips with the same group in the file.
"""

from __future__ import annotations

import csv
import hashlib
import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError

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

    def tie(self, seen: Mapping[str, str]) -> list[list[str]]:
        """Return clips in groups; ties are transitive.

        Args:
            seen: clip name -> the name that patterns, and the order within a group, use.

        Raises:
            InputError: if a pattern is not a regular expression.
        """
        try:
            compiled = [re.compile(pattern) for pattern in self.patterns]
        except re.error as error:
            raise InputError(
                f"data.split.groups={error.pattern!r}: not a regular expression ({error})"
            ) from error
        order = sorted(seen, key=lambda name: seen[name])
        parents: dict[Any, Any] = {}
        for name in order:
            for index, pattern in enumerate(compiled):
                if match := pattern.search(seen[name]):
                    parents[find_root(parents, name)] = find_root(parents, (index, match.groups()))
            if self.rows and name in self.rows:
                parents[find_root(parents, name)] = find_root(parents, (KEY, self.rows[name]))
        groups: dict[object, list[str]] = {}
        for name in order:
            groups.setdefault(find_root(parents, name), []).append(name)
        return list(groups.values())

    def names(self, seen: Mapping[str, str]) -> dict[str, str]:
        """Map each clip to its group's name: the column file's, else the name of the group's first clip."""
        rows = self.rows or {}
        return {name: rows.get(group[0], group[0]) for group in self.tie(seen) for name in group}


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
