"""Clips that a split divides though they may belong together: those of one subject, or of one folder."""

from __future__ import annotations

from collections import Counter, defaultdict

from memmlp.motion.preparing.amass_names import divided_subjects
from memmlp.motion.preparing.groups import untied
from memmlp.motion.preparing.manifest import Manifest


def divided_remark(manifest: Manifest) -> str:
    """Say that a seeded split may have the same people in training and in test; empty if it does not.

    It is also empty for published lists, which are used as they were published.
    """
    if manifest.split.get("kind") == "lists":
        return ""
    return divided_subjects_remark(manifest) or divided_folders_remark(manifest)


def divided_subjects_remark(manifest: Manifest) -> str:
    """Say that subjects of AMASS are in both training and test; empty if there are none."""
    divided = divided_subjects((_of_source(manifest, clip.name)[1], clip.split) for clip in manifest.clips)
    if not divided:
        return ""
    more = f" and {len(divided) - 1} more" if len(divided) > 1 else ""
    apart = "data=amass_s3 with one release of AMASS keeps subjects apart"
    return f"clips of {divided[0]}{more} are in training and in test; {apart}"


def divided_folders_remark(manifest: Manifest) -> str:
    """Say that folders have clips in both training and test which no group ties together; empty if none has.

    A folder is often a person or a session, unless it holds all clips of its source.
    """
    every = {clip.name: _of_source(manifest, clip.name) for clip in manifest.clips}
    clips = Counter(source for source, _ in every.values())
    held = Counter((source, folder) for source, below in every.values() for folder in _folders(below))
    parts: dict[tuple[str, str], list[str]] = defaultdict(list)
    for clip in manifest.clips:
        if clip.group == clip.name and untied(manifest.split, clip.name):
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
    return f"{tested}, and clips of their folders, {folders[0][0] or 'the top one'}{more}, are in training"


def _folders(name: str) -> list[str]:
    """Return the folders that a clip is in, the innermost first; "" if there is none."""
    folders = name.split("/")[:-1]
    return ["/".join(folders[:depth]) for depth in range(len(folders), 0, -1)] or [""]


def _of_source(manifest: Manifest, name: str) -> tuple[str, str]:
    """Return the beginning of a clip's name that names its source, which may be empty, and the rest."""
    for source in manifest.split.get("sources", ()):
        if name.startswith(f"{source}/"):
            return f"{source}/", name.removeprefix(f"{source}/")
    return "", name
