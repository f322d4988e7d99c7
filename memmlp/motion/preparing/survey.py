"""Finds the npz clips of a folder and reads each of them once, so that what is bad is known and said."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

from memmlp.common.errors import InputError, one_line
from memmlp.common.progress import progress_bar
from memmlp.motion.body import FPS
from memmlp.motion.clip import Skipped, resample
from memmlp.motion.formats.npz import NoMotion, read_clip
from memmlp.motion.plausible import check_plausible
from memmlp.motion.preparing.manifest import ClipRecord


@dataclass(frozen=True)
class Survey:
    """What a folder of npz files holds.

    Attributes:
        clips: sound clips, without split and group yet.
        skipped: bad files.
        ignored: number of npz files without motion.
        short: names of those of the bad files that are sound clips of too few frames.
    """

    clips: tuple[ClipRecord, ...]
    skipped: tuple[Skipped, ...]
    ignored: int
    short: tuple[str, ...] = ()

    @property
    def damaged(self) -> tuple[str, ...]:
        """Names of the bad files that are no sound clips."""
        return tuple(name for file in self.skipped if (name := clip_name(file.file)) not in self.short)


class TooShort(InputError):
    """A sound clip has too few frames."""


def survey(root: Path, min_frames: int = 2, strict: bool = False) -> Survey:
    """Read every npz below a folder.

    Raises:
        InputError: if there are none, or at the first bad one if `strict`.
    """
    clips, skipped, short, ignored = [], [], [], 0
    for file in progress_bar(sources(root), "reading"):
        path = root / file
        try:
            clips.append(_inspect(path, file, min_frames))
        except NoMotion:
            ignored += 1
        except InputError as error:
            if strict:
                raise
            skipped.append(Skipped(file, str(error).removeprefix(one_line(f"{path}: "))))
            short += [clip_name(file)] if isinstance(error, TooShort) else []
    return Survey(tuple(clips), tuple(skipped), ignored, tuple(short))


def sources(root: Path) -> list[str]:
    """Return the npz files below a folder, also through links: sorted paths relative to it."""
    if not root.is_dir():
        raise InputError(f"data.root: {root} is no folder; give it the folder with your npz clips")
    walk = os.walk(root, followlinks=True)
    files = (Path(folder, file) for folder, _, names in walk for file in names if file.endswith(".npz"))
    found = sorted(path.relative_to(root).as_posix() for path in files)
    if not found:
        raise InputError(f"data.root: no npz below {root}; make some with memmlp data synth or data import")
    return found


def _inspect(path: Path, file: str, min_frames: int) -> ClipRecord:
    """Return the record of a sound clip, without split and start; raise InputError for any other file."""
    name = clip_name(file)
    clip = read_clip(path, name)
    check_plausible(path, clip)
    resampled, how = resample(clip)
    if len(resampled) < min_frames:
        few = f"{len(resampled)} frames at {FPS} Hz"
        raise TooShort(f"{path}: {few}, fewer than {min_frames} (data.min_frames)")
    with open(path, "rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return ClipRecord(name, "", "", 0, len(resampled) - 1, digest, clip.fps, how)


def clip_name(file: str) -> str:
    return file.removesuffix(".npz")
