"""The manifest of a cache: its clips, its skipped files, and its split."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write
from memmlp.motion.body import FPS
from memmlp.motion.clip import SkippedFile
from memmlp.motion.preparing.find_clips import Root

FORMAT = 10  # version of the cache format; a new version makes all caches outdated
MANIFEST = "manifest.json"
PARTS = ("train", "val", "test")
STILL = "still"  # `content` of all clips without motion


@dataclass(frozen=True)
class ClipRecord:
    """A clip in the cache. `name` and `file` are paths below the data root, `split` is its part, `group` that
    of `Grouping.name_groups`; `start` and `length` locate its frames in the part's array. `sha256` is the
    digest of the source file, `content` that of the rotations in single precision, equal for copies and for
    clips with common motion (`duplicates`); `STILL` for a clip without motion. `fps` is the source's rate,
    Hz, `resampling` the method (`clip.resample`)."""

    name: str
    file: str
    split: str
    group: str
    start: int
    length: int
    sha256: str
    content: str
    fps: float
    resampling: str


class Total(NamedTuple):
    """The number of clips, and the number of frames at 60 Hz."""

    clips: int
    frames: int

    @property
    def hours(self) -> float:
        return self.frames / FPS / 3600


def find_copies(clips: Iterable[ClipRecord]) -> dict[str, str]:
    """Return the clips with common motion: clip -> the first clip with it."""
    firsts: dict[str, str] = {}
    moving = [clip for clip in clips if clip.content != STILL]
    pairs = {clip.name: firsts.setdefault(clip.content, clip.name) for clip in moving}
    return {name: first for name, first in pairs.items() if name != first}


@dataclass(frozen=True)
class Coverage:
    """The numbers of a split's entries (list entries, subsets) by subset, and of those without a clip;
    complete subsets are omitted. Both are empty for a split that divides all clips in the folder."""

    entry_counts: Mapping[str, int]
    missing_counts: Mapping[str, int]

    @classmethod
    def from_entries(cls, entry_counts: Mapping[str, int], missing: Iterable[str]) -> Coverage:
        """Make a coverage, given the number of entries by subset and the missing entries."""
        return cls(entry_counts, dict(Counter(entry.split("/")[0] for entry in sorted(missing))))

    @property
    def is_complete(self) -> bool:
        return not self.missing_counts

    @property
    def counts(self) -> tuple[int, int]:
        """The number of entries with a clip, and the total number of entries."""
        total = sum(self.entry_counts.values())
        return total - sum(self.missing_counts.values()), total

    def __str__(self) -> str:
        present, total = self.counts
        return f"{100 * present // max(total, 1)} % of the list ({present} of {total} entries)"

    @property
    def gap_description(self) -> str:
        present, total = self.counts
        missing = self.missing_counts.items()
        by_subset = (f"{name} {count} of {self.entry_counts[name]}" for name, count in missing)
        return f"{total - present} of {total} entries of the list have no clip ({', '.join(by_subset)})"

    def check(self, root: Root) -> None:
        """Raise InputError unless every entry has a clip below the data folder."""
        if not self.is_complete:
            raise InputError(f"data.root={root}: {self.gap_description}; data.partial=true accepts this")


@dataclass(frozen=True)
class Manifest:
    """The content of `manifest.json` in a cache. `digest` is a SHA-256 of everything that determines the
    frames and their parts. Groups are excluded, because training does not use groups. `request` is a SHA-256
    of the settings and each source file's path, size and times. It shows whether a cache is outdated."""

    digest: str
    request: str
    body: str  # "builtin", or the model file's name and a digest of its rest pose: "model.npz 0a1b2c3d"
    rest_joints: tuple[tuple[float, ...], ...]  # (22, 3), metres
    split: dict[str, Any]  # the split's settings
    min_frames: int  # minimum number of frames of a clip at 60 Hz
    interpolation: str  # method of resampling to 60 Hz, SPLINES or LINES
    clips: tuple[ClipRecord, ...]  # sorted by name
    skipped: tuple[SkippedFile, ...]  # bad files
    left_out: dict[str, int]  # top-level folder -> number of valid clips without a part
    listed: dict[str, int]  # subset -> number of its entries in the split's list; empty without a list
    missing: tuple[str, ...]  # the split's entries without a clip, not even a too short one
    duplicates: dict[str, str]  # dropped clip -> the kept clip of another part with the same motion
    unusual: dict[str, str]  # clip -> its likely mistakes (`plausibility.find_faults`)
    sources: tuple[str, ...] = ()  # names of the sources, with which clip names begin; empty for one folder
    format: int = FORMAT

    @classmethod
    def load(cls, out: Path) -> Manifest:
        """Load the manifest of a cache. Raises InputError if there is no finished cache of this format."""
        path = out / MANIFEST
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            if data["format"] != FORMAT:
                expected = f"must be {FORMAT}; prepare the data again"
                raise InputError(f"{path}: has format {data['format']}; {expected}")
            data["clips"] = tuple(ClipRecord(**clip) for clip in data["clips"])
            data["skipped"] = tuple(SkippedFile(**file) for file in data["skipped"])
            data["rest_joints"] = tuple(map(tuple, data["rest_joints"]))
            for name in ("missing", "sources"):
                data[name] = tuple(data[name])
            return cls(**data)
        except FileNotFoundError as error:
            raise InputError(f"{out}: has no finished cache; run memmlp data prepare") from error
        except (OSError, UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
            raise InputError(f"{path}: not a valid manifest ({error}); prepare the data again") from error

    def write(self, out: Path) -> None:
        """Write the manifest into the cache folder. A cache with a manifest is finished."""
        atomic_write(out / MANIFEST, json.dumps(asdict(self), indent=1))

    @cached_property
    def rest(self) -> np.ndarray:
        """Rest positions (22, 3), metres, float64."""
        return np.array(self.rest_joints)

    @cached_property
    def groups(self) -> dict[str, str]:
        """Clip name -> the clip's group; statistics count a group once."""
        return {clip.name: clip.group for clip in self.clips}

    @property
    def coverage(self) -> Coverage:
        return Coverage.from_entries(self.listed, self.missing)

    @cached_property
    def totals(self) -> dict[str, Total]:
        """Part -> its numbers of clips and frames."""
        lengths = {part: [clip.length for clip in self.clips if clip.split == part] for part in PARTS}
        return {part: Total(len(frames), sum(frames)) for part, frames in lengths.items()}

    def part(self, part: str) -> list[ClipRecord]:
        """Return the clips of a part, in the order of the part's array."""
        return [clip for clip in self.clips if clip.split == part]
