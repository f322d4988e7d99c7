"""Finds files in folders, such as the npz files of one or more. A file with several paths is listed once."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from memmlp.common.errors import InputError

SUFFIX = ".npz"  # in any letter case


@dataclass(frozen=True)
class NamedFolders:
    """Folders of clips by name that can replace one folder's path: `folders / "cmu/salsa/01.npz"`."""

    sources: Mapping[str, Path]

    @classmethod
    def from_paths(cls, paths: Sequence[Path]) -> NamedFolders:
        """Name each folder by the last component of its path. Raises InputError for equal names."""
        sources = {path.resolve().name: path for path in paths}
        if len(sources) < len(paths):
            wrong = f"data.root={', '.join(map(str, paths))}: two folders have the same name"
            raise InputError(f"{wrong}; give them names in data.sources")
        return cls(sources)

    def __truediv__(self, file: str) -> Path:
        """Return the path of a file, given as "SOURCE/RELATIVE_PATH"."""
        source, _, rest = file.partition("/")
        return self.sources[source] / rest

    def __str__(self) -> str:
        return ", ".join(map(str, self.sources.values()))

    @property
    def name(self) -> str:
        """The names of all sources, joined by "-"."""
        return "-".join(self.sources)

    def resolve(self) -> NamedFolders:
        return NamedFolders({name: path.resolve() for name, path in self.sources.items()})


Root = Path | NamedFolders  # the location of clips: one folder or several


@dataclass
class FolderContent:
    """The content of a folder, with relative paths: the sorted files, and folder that cannot be listed -> the
    reason. Of several paths of a file, the shortest is listed, and real before linked paths."""

    files: list[str] = field(default_factory=list)
    unreadable: dict[str, str] = field(default_factory=dict)


def find_clips(root: Root) -> FolderContent:
    """Find the npz files below one or more folders. Links are followed, and hidden files are ignored. Raises
    InputError if a folder does not exist or has no npz files."""
    if isinstance(root, Path):
        return _find_in_folder(root)
    result = FolderContent()
    for source, folder in root.sources.items():
        content = _find_in_folder(folder)
        result.files += [f"{source}/{file}" for file in content.files]
        result.unreadable |= {f"{source}/{path}": why for path, why in content.unreadable.items()}
    result.files.sort()
    return result


def get_clip_name(file: str) -> str:
    """Return a clip's name, which is its file's path without the suffix."""
    return file[: -len(SUFFIX)] if file.lower().endswith(SUFFIX) else file


def get_source_name(clip: str) -> str:
    """Return a clip's source, which is the first component of its name if there are several sources."""
    return clip.split("/")[0]


def _find_in_folder(root: Path) -> FolderContent:
    if not root.is_dir():
        raise InputError(f"data.root={root}: no such folder; must be the folder of your npz clips")
    content = find_files(root, SUFFIX)
    if not content.files:
        advice = "create them with memmlp data synth or memmlp data import"
        raise InputError(f"data.root={root}: has no npz files; {advice}")
    return content


def find_files(root: Path, *endings: str) -> FolderContent:
    """Find the files below a folder whose names end with one of the `endings`, in any letter case. Links to
    files and folders are followed, and hidden files are ignored."""
    content, files = FolderContent(), dict[object, str]()
    folders = {_identify_path(root)}
    level = [""]
    while level:  # level by level, so the shortest of several paths is found first
        entries = [entry for folder in level for entry in _list_folder(root, folder, content)]
        level = []
        for path, is_folder in entries:
            identity = _identify_path(root / path)
            if is_folder and identity not in folders:
                folders.add(identity)
                level.append(path)
            elif not is_folder and path.lower().endswith(endings):
                files.setdefault(identity, path)
    content.files = sorted(files.values())
    return content


def _list_folder(root: Path, folder: str, content: FolderContent) -> list[tuple[str, bool]]:
    """Return the visible paths in a folder, real paths before links, and whether each is a folder."""
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


def _identify_path(path: Path) -> tuple[int, int] | str:
    """Return a key that is equal for all paths of a file or folder, or the path of a dangling link."""
    try:
        stat = path.stat()
    except OSError:
        return str(path)
    return stat.st_dev, stat.st_ino
