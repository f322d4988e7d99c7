"""The manifest of a cache: its clips, the outcome for every file, and the split."""

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
from memmlp.motion.clip import Skipped
from memmlp.motion.preparing.find_clips import Root

FORMAT = 9  # number of the cache's format; a new one makes every cache again
MANIFEST = "manifest.json"
PARTS = ("train", "val", "test")
STILL = "still"  # the content of every clip without motion


@dataclass(frozen=True)
class ClipRecord:
    """A clip in the cache.

    Attributes:
        name: path below the data root without suffix.
        file: path below the data root.
        split: its part, "train", "val" or "test".
        group: name of the clip's group (`Grouping.names`); its own name where nothing ties it to another.
        start: the clip's first frame in its part's array.
        length: the clip's number of frames in that array.
        sha256: digest of the source file.
        content: digest of the frames in single precision, the same for every copy of the clip and for every
            clip that shares motion with it (`duplicates`); `STILL` for a clip without motion.
        fps: frame rate of the source, Hz.
        resampling: how the clip was resampled to 60 Hz.
    """

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
    """A number of clips, and of their frames at 60 Hz."""

    clips: int
    frames: int

    @property
    def hours(self) -> float:
        """The clips' duration."""
        return self.frames / FPS / 3600


@dataclass(frozen=True)
class Coverage:
    """The number of entries of a split (list entries, subsets) that have a clip.

    Attributes:
        listed: number of entries by subset; empty for a split that divides all clips in the folder.
        absent: number of entries without a clip by subset; complete subsets are left out.
    """

    listed: Mapping[str, int]
    absent: Mapping[str, int]

    @classmethod
    def of(cls, listed: Mapping[str, int], absent: Iterable[str]) -> Coverage:
        """Return the coverage of a split, given its entries without a clip."""
        return cls(listed, dict(Counter(entry.split("/")[0] for entry in sorted(absent))))

    @property
    def whole(self) -> bool:
        """Whether every entry has a clip."""
        return not self.absent

    @property
    def counts(self) -> tuple[int, int]:
        """The number of entries that have a clip, and the number of all entries."""
        total = sum(self.listed.values())
        return total - sum(self.absent.values()), total

    def __str__(self) -> str:
        present, total = self.counts
        return f"{100 * present // max(total, 1)} % of the list ({present} of {total} entries)"

    @property
    def gaps(self) -> str:
        """A description of the missing entries: their total number, and the number in each subset."""
        present, total = self.counts
        by_subset = [f"{name} {count} of {self.listed[name]}" for name, count in self.absent.items()]
        return (
            f"{total - present} of {total} entries of the split's list have no clip ({', '.join(by_subset)})"
        )

    def check(self, root: Root) -> None:
        """Raise InputError unless every entry has a clip below the data's root."""
        if not self.whole:
            raise InputError(f"data.root={root}: {self.gaps}; data.partial=true accepts an incomplete list")


@dataclass(frozen=True)
class Manifest:
    """The content of `manifest.json` in a cache.

    Attributes:
        digest: sha256 over everything that determines the frames and their split. Groups are not included,
            since training does not use them.
        request: sha256 over the settings and each source's path, size and times. It identifies a finished
            cache.
        body: "builtin", or the model file's name and a digest of its rest pose: "model.npz 0a1b2c3d".
        rest_joints: rest positions (22, 3), metres.
        split: the split's settings.
        min_frames: smallest number of frames at 60 Hz that a clip must have.
        interpolation: how clips of other rates were brought to 60 Hz: one of `INTERPOLATIONS`.
        clips: the clips, sorted by name.
        skipped: bad files.
        left_out: number of sound clips without a part in the split, by top-level folder.
        listed: number of the split's entries (list entries, subsets) by subset; empty without a list.
        missing: entries of the split without a sound clip; clips that are too short do not count.
        duplicates: clip that was left out -> the clip that shares motion with it in another part, and stays.
        unusual: clip -> its faults, though it may be sound (`plausibility.find_faults`).
        sources: names of the sources; every clip's name begins with one of them. Empty for one folder.
        format: format number of the cache.
    """

    digest: str
    request: str
    body: str
    rest_joints: tuple[tuple[float, ...], ...]
    split: dict[str, Any]
    min_frames: int
    interpolation: str
    clips: tuple[ClipRecord, ...]
    skipped: tuple[Skipped, ...]
    left_out: dict[str, int]
    listed: dict[str, int]
    missing: tuple[str, ...]
    duplicates: dict[str, str]
    unusual: dict[str, str]
    sources: tuple[str, ...] = ()
    format: int = FORMAT

    @classmethod
    def load(cls, out: Path) -> Manifest:
        """Load the manifest of a cache.

        Raises:
            InputError: if there is no finished cache of this format.
        """
        path = out / MANIFEST
        try:
            data = json.loads(path.read_text())
            if data["format"] != FORMAT:
                raise InputError(f"{path}: format {data['format']}, not {FORMAT}; prepare the data again")
            data["clips"] = tuple(ClipRecord(**clip) for clip in data["clips"])
            data["skipped"] = tuple(Skipped(**file) for file in data["skipped"])
            data["rest_joints"] = tuple(map(tuple, data["rest_joints"]))
            for name in ("missing", "sources"):
                data[name] = tuple(data[name])
            return cls(**data)
        except FileNotFoundError as error:
            raise InputError(f"{out}: no finished cache; run memmlp data prepare") from error
        except (OSError, UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
            raise InputError(f"{path}: not a cache's manifest ({error}); prepare the data again") from error

    def write(self, out: Path) -> None:
        """Write the manifest into the folder of a cache, which marks the cache as finished."""
        atomic_write(out / MANIFEST, json.dumps(asdict(self), indent=1))

    @cached_property
    def rest(self) -> np.ndarray:
        """Rest positions (22, 3), metres, float64."""
        return np.array(self.rest_joints)

    @cached_property
    def groups(self) -> dict[str, str]:
        """clip name -> its group; statistics count a group once."""
        return {clip.name: clip.group for clip in self.clips}

    @property
    def coverage(self) -> Coverage:
        """The number of the split's entries that have a clip."""
        return Coverage.of(self.listed, self.missing)

    @cached_property
    def totals(self) -> dict[str, Total]:
        """part -> the number of its clips and frames."""
        lengths = {part: [clip.length for clip in self.clips if clip.split == part] for part in PARTS}
        return {part: Total(len(frames), sum(frames)) for part, frames in lengths.items()}

    def part(self, part: str) -> list[ClipRecord]:
        """Return the clips of a part, in the order of its array."""
        return [clip for clip in self.clips if clip.split == part]
