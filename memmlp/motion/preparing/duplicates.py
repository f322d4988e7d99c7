"""Clips with the same frames: they are never in two parts of a split, and form one group.

Copies are found by their frames, so a file that was saved again is a copy, and so are one at another frame
rate (`resampled_duplicates`) and one that has some of the frames, or is mirrored (`shared_stretches`).
Clips without any motion can't be told apart, so they do not count as copies. If the split divides all clips
in the folder, copies are drawn together, like any group. If it is a published list with copies in several
parts, those in training give way to those in validation, and both to those in test: the test set stays as
published, and nothing in it was seen in training. Copies within one part stay, as in the list; statistics
count their group once.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from memmlp.motion.preparing.manifest import STILL, ClipRecord
from memmlp.motion.preparing.splits import PARTS, Split


def one_content(
    clips: Sequence[ClipRecord], pairs: Iterable[tuple[ClipRecord, ClipRecord]]
) -> list[ClipRecord]:
    """Return the clips such that those of a pair have one content, the first one's; pairs are transitive."""
    content: dict[str, str] = {}  # of a copy -> of what it is a copy of

    def original(of: str) -> str:
        while of in content:
            of = content[of]
        return of

    for one, other in pairs:
        if (first := original(one.content)) != (second := original(other.content)):
            content[second] = first
    return [replace(clip, content=original(clip.content)) for clip in clips]


def assign(
    split: Split, clips: Sequence[ClipRecord]
) -> tuple[dict[str, str | None], dict[str, str], dict[str, str]]:
    """Return each clip's part and group, and for each dropped copy the clip that was kept.

    Raises:
        InputError: if the split is impossible.
    """
    found = split.assign([clip.name for clip in clips])
    groups = tied(clips, found.groups)
    if split.listed or groups == found.groups:
        parts, gave_way = one_part_each(clips, found.parts)
        return parts, groups, gave_way
    firsts: dict[str, str] = {}
    for name in sorted(groups):
        firsts.setdefault(groups[name], name)
    drawn = split.assign(sorted(firsts.values())).parts
    return split.limited({name: drawn[firsts[groups[name]]] for name in groups}, groups), groups, {}


def one_part_each(
    clips: Sequence[ClipRecord], parts: Mapping[str, str | None]
) -> tuple[dict[str, str | None], dict[str, str]]:
    """Return the parts such that no frames are in two of them, and each dropped clip -> a kept copy of it.

    Args:
        clips: the clips with their content.
        parts: each clip's part, or None.
    """
    kept, gave_way = dict(parts), {}
    for names in _copies(clips):
        last = max((PARTS.index(part) for name in names if (part := parts[name])), default=0)
        staying = [name for name in names if parts[name] == PARTS[last]]
        for name in names:
            if parts[name] not in (None, PARTS[last]):
                kept[name], gave_way[name] = None, staying[0]
    return kept, gave_way


def tied(clips: Sequence[ClipRecord], groups: Mapping[str, str]) -> dict[str, str]:
    """Return each clip's group; groups that share frames are merged, and named after the first of them."""
    merged = {group: group for group in groups.values()}

    def last(group: str) -> str:
        while merged[group] != group:
            group = merged[group]
        return group

    for names in _copies(clips):
        ends = {last(groups[name]) for name in names}
        merged |= dict.fromkeys(ends, min(ends))
    return {name: last(group) for name, group in groups.items()}


def _copies(clips: Sequence[ClipRecord]) -> list[list[str]]:
    """Return the sorted names of clips with the same frames, for all frames that occur more than once."""
    by_content = defaultdict(list)
    for clip in clips:
        if clip.content != STILL:
            by_content[clip.content].append(clip.name)
    return [sorted(names) for names in by_content.values() if len(names) > 1]
