"""Finds the npz files of one or more folders: each file once, however many paths lead to it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from memmlp.common.errors import InputError

SUFFIX = ".npz"  # in any letter case


@dataclass(frozen=True)
class Folders:
    """Named folders of clips, used in place of one folder's path: `folders / "cmu/salsa/01.npz"`.

    Attributes:
        sources: name -> folder.
    """

    sources: Mapping[str, Path]

    @classmethod
    def of(cls, paths: Sequence[Path]) -> Folders:
        """Name folders after their own last parts. Raises InputError if two have the same name."""
        sources = {path.resolve().name: path for path in paths}
        if len(sources) < len(paths):
            raise InputError(
                f"data.root={', '.join(map(str, paths))}: two folders have the same name; "
                "give them names in data.sources"
            )
        return cls(sources)

    def __truediv__(self, file: str) -> Path:
        """Return the path of a file below one of the folders."""
        source, _, rest = file.partition("/")
        return self.sources[source] / rest

    def __str__(self) -> str:
        return ", ".join(map(str, self.sources.values()))

    @property
    def name(self) -> str:
        """The names of all sources."""
        return "-".join(self.sources)

    def resolve(self) -> Folders:
        """Return the folders with absolute paths."""
        return Folders({name: path.resolve() for name, path in self.sources.items()})


Root = Path | Folders
"""Where clips are."""


@dataclass
class FoundFiles:
    """The content of a folder; paths are relative to it.

    Attributes:
        files: the npz files, sorted, each by the path that is nearest to the folder, real before linked.
        unreadable: folders that cannot be listed -> why.
    """

    files: list[str] = field(default_factory=list)
    unreadable: dict[str, str] = field(default_factory=dict)


def find_clips(root: Root) -> FoundFiles:
    """Find the npz files below one folder or several, also behind links. Hidden files are ignored.

    Raises:
        InputError: if a folder does not exist or has no npz.
    """
    if isinstance(root, Path):
        return _find_in_folder(root)
    result = FoundFiles()
    for source, folder in root.sources.items():
        content = _find_in_folder(folder)
        result.files += [f"{source}/{file}" for file in content.files]
        result.unreadable |= {f"{source}/{path}": why for path, why in content.unreadable.items()}
    result.files.sort()
    return result


def clip_name(file: str) -> str:
    """Return a clip's name: its path without the suffix."""
    return file[: -len(SUFFIX)] if file.lower().endswith(SUFFIX) else file


def source_of(clip: str) -> str:
    """Return the source of a clip: if there are several sources, its name begins with the source's name."""
    return clip.split("/")[0]


def _find_in_folder(root: Path) -> FoundFiles:
    if not root.is_dir():
        raise InputError(f"data.root={root}: no such folder; expected the folder with your npz clips")
    content, files = FoundFiles(), dict[object, str]()
    folders = {_identity(root)}
    level = [""]
    while level:  # one depth after the other, so that of two paths the shorter one counts
        entries = [entry for folder in level for entry in _list_folder(root, folder, content)]
        level = []
        for path, is_folder in entries:
            identity = _identity(root / path)
            if is_folder and identity not in folders:
                folders.add(identity)
                level.append(path)
            elif not is_folder and path.lower().endswith(SUFFIX):
                files.setdefault(identity, path)
    content.files = sorted(files.values())
    if not content.files:
        raise InputError(f"data.root={root}: no npz in it; make some with memmlp data synth or data import")
    return content


def _list_folder(root: Path, folder: str, content: FoundFiles) -> list[tuple[str, bool]]:
    """Return the visible paths in a folder, real ones before links, and whether each is a folder itself."""
    try:
        with os.scandir(root / folder) as listing:
            shown = [entry for entry in listing if not entry.name.startswith(".")]
    except OSError as error:
        content.unreadable[folder] = f"cannot be listed ({error.strerror})"
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
