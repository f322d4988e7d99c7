"""Remarks on a split: clips on both sides that may belong together, and patterns without a match."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping
from typing import Any

from memmlp.motion.preparing.amass_names import divided_subjects, strip_archives
from memmlp.motion.preparing.manifest import Manifest


def divided_remark(manifest: Manifest) -> str:
    """Warn that a seeded split may have the same people in training and in test; empty if it does not.

    It is also empty for published lists, which are used as they were published.
    """
    if manifest.split.get("kind") == "lists":
        return ""
    return _divided_subjects_remark(manifest) or _divided_folders_remark(manifest)


def unmatched_patterns_remark(split: Mapping[str, Any], names: Collection[str]) -> str:
    """Warn that a split has patterns of groups and none of them matches a clip; empty otherwise.

    Args:
        split: the split's settings (`Split.describe`).
        names: clips' names.
    """
    remarks = []
    for source, own in split.get("sources", {}).items():
        below = [name.removeprefix(f"{source}/") for name in names if name.startswith(f"{source}/")]
        remarks += [f"{source}: {remark}"] if (remark := unmatched_patterns_remark(own, below)) else []
    patterns = split.get("groups", ())
    if patterns and all(_is_untied(split, name) for name in names):
        remarks += [
            f"none of the {len(patterns)} patterns of data.split.groups matches a clip's name (the first is "
            f"{patterns[0]}), so each clip counts as independent, and clips of one person may be in training "
            "and in test; data/grouping@data.split=NAME has patterns for other collections, and "
            "data.split.groups_file can list who is in which clip"
        ]
    return "; ".join(remarks)


def _divided_subjects_remark(manifest: Manifest) -> str:
    divided = divided_subjects((_by_source(manifest, clip.name)[1], clip.split) for clip in manifest.clips)
    if not divided:
        return ""
    more = f" and {len(divided) - 1} more" if len(divided) > 1 else ""
    return (
        f"clips of {divided[0]}{more} are in training and in test; "
        "data=amass_s3 with one release of AMASS keeps subjects apart"
    )


def _divided_folders_remark(manifest: Manifest) -> str:
    """Warn that folders have clips in both training and test without a common group.

    A folder is often a person or a session, unless it holds all clips of its source.
    """
    every = {clip.name: _by_source(manifest, clip.name) for clip in manifest.clips}
    clips = Counter(source for source, _ in every.values())
    held = Counter((source, folder) for source, below in every.values() for folder in _folders(below))
    parts: dict[tuple[str, str], list[str]] = defaultdict(list)
    for clip in manifest.clips:
        if clip.group == clip.name and _is_untied(manifest.split, clip.name):
            source, below = every[clip.name]
            own, *above = _folders(below)
            # Where each take has a folder to itself, the person is the one above.
            shared = next((folder for folder in (own, *above) if held[source, folder] > 1), own)
            parts[source, shared].append(clip.split)
    folders = [
        (f"{source}{folder}", found.count("test"))
        for (source, folder), found in parts.items()
        if held[source, folder] < clips[source] and {"train", "test"} <= set(found)
    ]
    if not folders:
        return ""
    tested = f"{sum(count for _, count in folders)} test clips are tied to no others (data.split.groups)"
    more = f" and {len(folders) - 1} more" if len(folders) > 1 else ""
    return f"{tested}, but clips of their folders, {folders[0][0] or 'the top one'}{more}, are in training"


def _is_untied(split: Mapping[str, Any], name: str) -> bool:
    for source, own in split.get("sources", {}).items():
        if name.startswith(f"{source}/"):
            return _is_untied(own, name.removeprefix(f"{source}/"))
    return not any(re.search(pattern, strip_archives(name)) for pattern in split.get("groups", ()))


def _folders(name: str) -> list[str]:
    """Return the folders that a clip is in, the innermost first; "" at the top."""
    folders = name.split("/")[:-1]
    return ["/".join(folders[:depth]) for depth in range(len(folders), 0, -1)] or [""]


def _by_source(manifest: Manifest, name: str) -> tuple[str, str]:
    """Return the beginning of a clip's name that names its source, which may be empty, and the rest."""
    for source in manifest.split.get("sources", ()):
        if name.startswith(f"{source}/"):
            return f"{source}/", name.removeprefix(f"{source}/")
    return "", name
