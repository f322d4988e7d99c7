"""Where the motion of an experiment comes from, and where its cache lies."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from filelock import FileLock

from memmlp.motion.prepare import ClipFolder, Manifest, finished, prepare

if TYPE_CHECKING:
    from memmlp.motion.dataset import MotionDataset


class Prepared(NamedTuple):
    """Prepared motion: the folder of its cache, and its manifest."""

    cache: Path
    manifest: Manifest

    @property
    def digest(self) -> str:
        """The digest of the data, which stands for it in every identity."""
        return self.manifest.digest

    def open(self, split: str) -> MotionDataset:
        """A split of the cache, memory-mapped (`MotionDataset.open`)."""
        from memmlp.motion.dataset import MotionDataset  # with torch, which finding finished work needs not

        return MotionDataset.open(self.cache, split)


@dataclass(frozen=True)
class MotionSource:
    """A folder of clips with its split and body, generated where it is synthetic, and its cache.

    Attributes:
        source: the folder of clips, its split and body.
        generate: makes the folder where it is synthetic; None for the user's own.
        caches: folder of all caches.
    """

    source: ClipFolder
    generate: Callable[[Path], object] | None
    caches: Path

    @property
    def cache(self) -> Path:
        """Where the cache lies: one folder for each source, split and body."""
        key = repr(replace(self.source, root=self.source.root.resolve()))
        return self.caches / f"{self.source.root.name}-{hashlib.sha256(key.encode()).hexdigest()[:8]}"

    def prepare(self) -> Prepared:
        """The cache, made where it is missing or out of date, and its manifest."""
        if self.generate is not None and not self.source.root.exists():
            self.source.root.parent.mkdir(parents=True, exist_ok=True)
            with FileLock(self.source.root.with_name(f".{self.source.root.name}.lock")):
                if not self.source.root.exists():  # nobody else has made it while this process waited
                    self._generate(self.generate)
        return Prepared(self.cache, prepare(self.source, self.cache))

    def digest(self) -> str | None:
        """The digest of the prepared data; None where the cache is missing or out of date."""
        manifest = finished(self.source, self.cache)
        return manifest.digest if manifest else None

    def _generate(self, generate: Callable[[Path], object]) -> None:
        """Make the clips beside their place and move them there, so that a kill leaves no half folder."""
        root = self.source.root
        unfinished = root.with_name(root.name + ".unfinished")
        generate(unfinished)
        unfinished.rename(root)
