"""Finds the npz files of a folder, each once however many paths lead to it, and reports what it ignores."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from memmlp.common.errors import InputError

SUFFIX = ".npz"  # in any case


@dataclass
class FoundFiles:
    """The content of a folder; paths are relative to it.

    Attributes:
        files: the npz files, sorted, each by the path that is nearest to the folder, real before linked.
        links: other paths of the same files or folders (symbolic or hard links) -> the path that is used.
        unreadable: folders that cannot be listed -> why.
        passed_over: number of files that are no npz, by suffix.
    """

    files: list[str] = field(default_factory=list)
    links: dict[str, str] = field(default_factory=dict)
    unreadable: dict[str, str] = field(default_factory=dict)
    passed_over: Counter[str] = field(default_factory=Counter)


def find_clips(root: Path) -> FoundFiles:
    """Find the npz files below a folder, also behind links, each file and each folder once.

    Raises:
        InputError: if there is no such folder, or no npz in it.
    """
    if not root.is_dir():
        raise InputError(f"data.root: {root} is no folder; give it the folder with your npz clips")
    found, files = FoundFiles(), dict[object, str]()
    folders: dict[object, str] = {_identity(root): "."}
    level = [""]
    while level:  # one depth after the other, so that of two paths the shorter one counts
        entries = [entry for folder in level for entry in _entries(root, folder, found)]
        level = []
        for path, is_folder in entries:
            if not is_folder and Path(path).suffix.lower() != SUFFIX:
                found.passed_over[Path(path).suffix.lower() or "no suffix"] += 1
                continue
            first = (folders if is_folder else files).setdefault(_identity(root / path), path)
            if first != path:
                found.links[path] = first
            elif is_folder:
                level.append(path)
    found.files = sorted(files.values())
    if not found.files:
        raise InputError(f"data.root: no npz below {root}; make some with memmlp data synth or data import")
    return found


def clip_name(file: str) -> str:
    """Return a clip's name: its path without the suffix."""
    return file[: -len(SUFFIX)] if file.lower().endswith(SUFFIX) else file


def _entries(root: Path, folder: str, found: FoundFiles) -> list[tuple[str, bool]]:
    """Return the paths in a folder with whether each is a folder itself: sorted, real ones before links.

    Hidden ones are left out: an import that was killed leaves its unfinished clips in a hidden folder.
    """
    try:
        with os.scandir(root / folder) as listing:
            shown = [entry for entry in listing if not entry.name.startswith(".")]
    except OSError as error:
        found.unreadable[folder] = f"cannot be listed ({error.strerror})"
        return []
    entries = sorted(shown, key=lambda entry: (entry.is_symlink(), entry.name))
    return [((Path(folder) / entry.name).as_posix(), _is_folder(entry)) for entry in entries]


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a link that leads back to itself
        return False


def _identity(path: Path) -> tuple[int, int] | str:
    """Return a key that is the same for all paths of a file or folder; a dangling link equals only itself."""
    try:
        stat = path.stat()
    except OSError:
        return str(path)
    return stat.st_dev, stat.st_ino
