"""Reads every npz of a folder once, so that bad, odd and duplicate files are known and reported."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError, escape_line_breaks
from memmlp.common.files import file_digest
from memmlp.common.progress import progress_bar
from memmlp.motion.body import FPS
from memmlp.motion.clip import LINES, Clip, Skipped, resample
from memmlp.motion.formats.npz import NoMotion, read_clip
from memmlp.motion.plausibility import check_plausible
from memmlp.motion.preparing.duplicates import (
    Marks,
    find_resampled_copies,
    find_shared_stretches,
    first_frames,
    mark_frames,
    merge_contents,
)
from memmlp.motion.preparing.find_clips import Root, clip_name, find_clips
from memmlp.motion.preparing.manifest import STILL, ClipRecord


@dataclass(frozen=True)
class Survey:
    """The content of a folder of npz files.

    Attributes:
        clips: sound clips, without split and group yet.
        skipped: bad files.
        short: names of the bad files that are sound clips with too few frames.
        unusual: clip -> its faults, though it may be sound.
    """

    clips: tuple[ClipRecord, ...]
    skipped: tuple[Skipped, ...]
    short: tuple[str, ...]
    unusual: dict[str, str]

    @property
    def damaged(self) -> tuple[str, ...]:
        """Names of the bad files that are not just short."""
        return tuple(name for file in self.skipped if (name := clip_name(file.file)) not in self.short)

    @property
    def duplicates(self) -> dict[str, str]:
        """Clip -> the first clip that shares motion with it."""
        firsts: dict[str, str] = {}
        moving = [clip for clip in self.clips if clip.content != STILL]
        pairs = {clip.name: firsts.setdefault(clip.content, clip.name) for clip in moving}
        return {name: first for name, first in pairs.items() if name != first}


class TooShort(InputError):
    """A sound clip has too few frames."""


def survey(root: Root, min_frames: int = 2, strict: bool = False) -> Survey:
    """Read every npz below a folder.

    Raises:
        InputError: if there are none, or for the first bad file if `strict`.
    """
    clips: dict[str, ClipRecord] = {}
    firsts: dict[str, np.ndarray] = {}
    marks: dict[str, tuple[Marks, Marks]] = {}
    odd: dict[str, str] = {}
    short, content = [], find_clips(root)
    skipped = [Skipped(folder, reason) for folder, reason in content.unreadable.items()]
    for file in progress_bar(content.files, "reading"):
        path, name = root / file, clip_name(file)
        try:
            _check_name(path, file, clips)
            clip = read_clip(path, name)
            faults = check_plausible(path, clip)
            resampled, method = resample(clip, interpolation=LINES)  # the survey is the same with either
            if len(resampled) < min_frames:
                few = f"{len(resampled)} frames at {FPS} Hz"
                raise TooShort(f"{path}: {few}, fewer than data.min_frames={min_frames}")
        except NoMotion:  # such as AMASS' files of shapes
            continue
        except InputError as error:
            if strict:
                raise
            skipped.append(
                Skipped(escape_line_breaks(file), str(error).removeprefix(escape_line_breaks(f"{path}: ")))
            )
            short += [name] if isinstance(error, TooShort) else []
        else:
            digests = file_digest(path), _content_digest(clip)
            clips[name] = ClipRecord(name, file, "", "", 0, len(resampled) - 1, *digests, clip.fps, method)
            firsts[name], marks[name] = first_frames(clip), mark_frames(resampled)
            odd |= {name: faults} if faults else {}
    records = list(clips.values())
    records = merge_contents(records, find_resampled_copies(root, records, firsts))
    records = merge_contents(records, find_shared_stretches(root, records, marks))
    return Survey(tuple(records), tuple(skipped), tuple(short), odd)


def _check_name(path: Path, file: str, clips: dict[str, ClipRecord]) -> None:
    """Raise InputError unless the path is a regular file with a valid and new clip name."""
    if escape_line_breaks(file) != file:
        raise InputError(f"{path}: line feeds or other control characters in its name; rename it")
    if clip_name(file) in clips:
        raise InputError(f"{path}: {clips[clip_name(file)].file} has the same name; rename one of them")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: not a regular file")


def _content_digest(clip: Clip) -> str:
    """Return a digest of the frames in single precision, whatever their saved type and stated frame rate."""
    numbers = np.concatenate(
        [clip.poses.reshape(len(clip), -1), clip.trans], 1, dtype="<f4", casting="same_kind"
    )
    if (numbers == numbers[0]).all():
        return STILL
    return hashlib.sha256((numbers + np.float32(0)).tobytes()).hexdigest()  # + 0, for -0 is 0
