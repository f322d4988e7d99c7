"""The source of an experiment's motion, and the folder of its cache."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from memmlp.common.errors import InputError
from memmlp.common.lease import Lock, publish, temporary_path
from memmlp.motion.preparing.cache import ClipFolder, finished_cache, prepare
from memmlp.motion.preparing.find_clips import clip_name, find_clips
from memmlp.motion.preparing.manifest import Coverage, Manifest

if TYPE_CHECKING:
    from memmlp.motion.dataset import MotionDataset


class Prepared(NamedTuple):
    """Prepared motion.

    Attributes:
        cache: the folder of the cache.
        manifest: the cache's manifest.
    """

    cache: Path
    manifest: Manifest

    @property
    def digest(self) -> str:
        """The digest of the data, which is part of run ids."""
        return self.manifest.digest

    def open(self, part: str) -> MotionDataset:
        """Open a part of the cache, memory-mapped (`MotionDataset.open`).

        Raises:
            InputError: if the cache is unfinished, or was replaced by a cache of other clips.
        """
        # Imported here, since it imports torch, which finding finished work does not need.
        from memmlp.motion.dataset import MotionDataset

        part_of_cache = MotionDataset.open(self.cache, part)
        # Checked last: arrays are replaced after the old manifest was removed, before the new one is written.
        if Manifest.load(self.cache).digest != self.digest:
            raise InputError(
                f"{self.cache}: was prepared again from other clips while this ran; start it again, or "
                "restore the clips"
            )
        return part_of_cache


@dataclass(frozen=True)
class MotionSource:
    """One or more folders of clips and their cache; synthetic clips are generated.

    Attributes:
        clips: the folder of clips, or several, with its split and body.
        generate: makes a synthetic folder; None for the user's own.
        caches: folder of all caches.
        partial: whether entries of the split may lack clips.
    """

    clips: ClipFolder
    generate: Callable[[Path], object] | None
    caches: Path
    partial: bool = False

    @property
    def cache(self) -> Path:
        """The folder of the cache; each combination of clips and settings has its own."""
        key = repr(replace(self.clips, root=self.clips.root.resolve())) + (self.groups_digest or "")
        return self.caches / f"{self.clips.root.name}-{hashlib.sha256(key.encode()).hexdigest()[:8]}"

    @property
    def groups_digest(self) -> str | None:
        """A digest of the column file that says which clips belong together; None without one."""
        return self.clips.split.groups_digest

    def prepare(self) -> Prepared:
        """Return the cache with its manifest; it is made if it is missing or out of date.

        Synthetic clips are generated first, where the source has any.

        Raises:
            InputError: if the cache can't be made, or if, without `partial`, an entry of the split's list has
                no clip. A missing file is reported before any file is read.
        """
        if self.generate is not None:
            _make_once(Path(str(self.clips.root)), self.generate)
        split, root = self.clips.split, self.clips.root
        if not self.partial and split.listed:
            names = [clip_name(file) for file in find_clips(root).files]
            Coverage.of(split.listed, split.missing(names)).check(root)
        prepared = Prepared(self.cache, prepare(self.clips, self.cache))
        if not self.partial:
            prepared.manifest.coverage.check(root)
        return prepared

    def digest(self) -> str | None:
        """Return the digest of the prepared data; None if the cache is missing or out of date."""
        manifest = finished_cache(self.clips, self.cache)
        return manifest.digest if manifest else None


def _make_once(root: Path, generate: Callable[[Path], object]) -> None:
    """Generate the clips of a folder that does not exist yet; concurrent callers wait for one another.

    They are made in a temporary folder that is then renamed, so that a kill leaves no incomplete folder.
    """
    if root.exists():
        return
    root.parent.mkdir(parents=True, exist_ok=True)
    with Lock(root.parent, root.name).hold():
        if not root.exists():  # no other process made it while this one waited
            unfinished = temporary_path(root)
            generate(unfinished)
            publish(unfinished, root)
