"""Clips of the same frames: never in two parts of a split, and one group.

They are told by their frames, so a file that was saved again is one, too, and so is one at another frame rate
(`resampled_copies`); clips without any motion are not told apart, and so are no copies. Where the split
divides whatever there is, copies are drawn together, like any group. Where it is a published list that has
them in several parts, those in training give way to those in validation, and both to those in testing: the
test set stays as published, and nothing in it was seen. Copies within one part stay, as the list has them;
statistics count their group once.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

from memmlp.motion.preparing.manifest import STILL, ClipRecord
from memmlp.motion.preparing.splits import PARTS, Split


def assign(
    split: Split, clips: Sequence[ClipRecord]
) -> tuple[dict[str, str | None], dict[str, str], dict[str, str]]:
    """Return each clip's part and group, and for each dropped copy the clip that stayed.

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
    """Return the parts with no frames in two of them, and the clips that gave way -> one that stayed.

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
    """Return each clip's group; groups that share frames are one, named after the first of them."""
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
    """Return the names of clips of the same frames, sorted, for all frames that are there more than once."""
    by_content = defaultdict(list)
    for clip in clips:
        if clip.content != STILL:
            by_content[clip.content].append(clip.name)
    return [sorted(names) for names in by_content.values() if len(names) > 1]
