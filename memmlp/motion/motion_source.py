"""The motion source of an experiment, and the cache of its prepared motion."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.lease import Lock, publish_at_end
from memmlp.motion.clip import resample
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.preparing.cache import ClipFolder, compute_frame_blocks, load_finished_cache, prepare_cache
from memmlp.motion.preparing.find_clips import find_clips, get_clip_name
from memmlp.motion.preparing.manifest import Coverage, Manifest

if TYPE_CHECKING:
    from memmlp.motion.dataset import MotionDataset


class PreparedMotion(NamedTuple):
    cache: Path
    manifest: Manifest

    @property
    def digest(self) -> str:
        """A digest of the data, which is part of run ids."""
        return self.manifest.digest

    def has(self, part: str) -> bool:
        return bool(self.manifest.part(part))

    def open(self, part: str) -> MotionDataset:
        """Open a part of the cache, memory-mapped (`MotionDataset.open`). Raises InputError if the cache is
        unfinished, or was replaced by a cache of different clips."""
        # Imported here because it imports torch, which the search for finished runs does not need.
        from memmlp.motion.dataset import MotionDataset

        part_of_cache = MotionDataset.open(self.cache, part)
        # Checked last, because arrays are replaced while the cache has no manifest.
        if Manifest.load(self.cache).digest != self.digest:
            changed = "was prepared again from other clips during this run"
            raise InputError(f"{self.cache}: {changed}; start the run again, or restore the clips")
        return part_of_cache


@dataclass(frozen=True)
class ShippedMotion:
    """One AMASS npz file as the test clips of a shipped network, with the rest joints (22, 3) of its body,
    metres, for use without the network's data."""

    clip: Path
    rest: np.ndarray

    def open(self, part: str) -> MotionDataset:
        """Return the clip as a dataset. Raises InputError for another part than "test"."""
        import torch

        from memmlp.motion.dataset import MotionDataset

        if part != "test":
            only = "a shipped network has only this clip"
            raise InputError(f"{self.clip.stem}: {only}; {part} clips need a run of your own")
        clip, _ = resample(read_clip(self.clip, self.clip.stem))
        frames = torch.from_numpy(np.concatenate(list(compute_frame_blocks(clip, self.rest))))
        return MotionDataset(frames, torch.tensor([0]), torch.tensor([len(frames)]), [clip.name])


@dataclass(frozen=True)
class MotionSource:
    """One or more folders of clips, and their cache in the folder of all caches. `generate` generates the
    synthetic clips of a folder; None for the user's clips. `partial`: the split's list may have entries
    without a clip."""

    clips: ClipFolder
    generate: Callable[[Path], object] | None
    caches: Path
    partial: bool = False

    @property
    def cache(self) -> Path:
        """The cache folder, which depends on the clips and all settings."""
        key = repr(replace(self.clips, root=self.clips.root.resolve())) + (self.groups_digest or "")
        return self.caches / f"{self.clips.root.name}-{hashlib.sha256(key.encode()).hexdigest()[:8]}"

    @property
    def groups_digest(self) -> str | None:
        """A digest of the file that groups the clips (`data.split.groups_file`); None without a file."""
        return self.clips.split.groups_digest

    def prepare(self) -> PreparedMotion:
        """Return the cache and its manifest. A missing or outdated cache, and missing synthetic clips, are
        made first. Raises InputError if the cache can't be prepared, or if the split's list has an entry
        without a clip and `partial` is false. Missing files are reported before any file is read."""
        if self.generate is not None:
            _generate_once(Path(str(self.clips.root)), self.generate)
        split, root = self.clips.split, self.clips.root
        if not self.partial and split.entry_counts:
            names = [get_clip_name(file) for file in find_clips(root).files]
            Coverage.from_entries(split.entry_counts, split.find_missing_entries(names)).check(root)
        prepared = PreparedMotion(self.cache, prepare_cache(self.clips, self.cache))
        if not self.partial:
            prepared.manifest.coverage.check(root)
        return prepared

    def find_digest(self) -> str | None:
        """Return the digest of the prepared data; None if the cache is missing or outdated."""
        manifest = load_finished_cache(self.clips, self.cache)
        return manifest.digest if manifest else None


def _generate_once(root: Path, generate: Callable[[Path], object]) -> None:
    """Generate a folder of clips unless it exists; only one process does so at a time. The clips are
    generated in a temporary folder that is renamed at the end."""
    if root.exists():
        return
    root.parent.mkdir(parents=True, exist_ok=True)
    with Lock(root.parent, root.name).hold():
        if not root.exists():  # another process may have generated it meanwhile
            with publish_at_end(root) as unfinished:
                generate(unfinished)
