"""Several folders of clips as one; each folder's name is put in front of its clips' names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.motion.preparing.find_clips import FoundFiles, find_clips


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
                f"data.root: {', '.join(map(str, paths))}: two folders of one name; name them in data.sources"
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
        """The sources' names."""
        return "-".join(self.sources)

    def resolve(self) -> Folders:
        """Return the folders with absolute paths."""
        return Folders({name: path.resolve() for name, path in self.sources.items()})


Root = Path | Folders
"""Where clips are."""


def find_all(root: Root) -> FoundFiles:
    """Find the npz files below one folder or several (see `find_clips`).

    Raises:
        InputError: if a folder does not exist or has no npz.
    """
    if isinstance(root, Path):
        return find_clips(root)
    every = FoundFiles()
    for source, folder in root.sources.items():
        found = find_clips(folder)
        every.files += [f"{source}/{file}" for file in found.files]
        every.links |= {f"{source}/{path}": f"{source}/{file}" for path, file in found.links.items()}
        every.unreadable |= {f"{source}/{path}": why for path, why in found.unreadable.items()}
        every.passed_over += found.passed_over
    every.files.sort()
    return every


def source_of(clip: str) -> str:
    """Return the source of a clip, with whose name the clip's name begins, if there are several sources."""
    return clip.split("/")[0]
