"""Reads every npz file of a folder, and finds bad, unusual and duplicate clips."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError, escape_line_breaks
from memmlp.common.files import file_digest
from memmlp.common.progress import progress_bar
from memmlp.motion.body import FPS
from memmlp.motion.clip import Clip, SkippedFile, resample
from memmlp.motion.formats.npz import NoMotionError, read_clip
from memmlp.motion.plausibility import check_plausible
from memmlp.motion.preparing.duplicates import (
    MarkedFrames,
    compute_first_frames,
    find_conversions,
    find_resampled_copies,
    find_shared_stretches,
    mark_frames,
    mark_turns,
    merge_contents,
)
from memmlp.motion.preparing.find_clips import Root, find_clips, get_clip_name
from memmlp.motion.preparing.manifest import STILL, ClipRecord, find_copies


@dataclass(frozen=True)
class Survey:
    """The result of reading a folder: valid clips without split and group, bad files (also too short clips),
    the names of the too short clips, and clip -> its likely mistakes."""

    clips: tuple[ClipRecord, ...]
    skipped: tuple[SkippedFile, ...]
    short: tuple[str, ...]
    unusual: dict[str, str]

    @property
    def damaged_files(self) -> tuple[str, ...]:
        """Names of the bad files, except for too short clips."""
        return tuple(name for file in self.skipped if (name := get_clip_name(file.file)) not in self.short)

    @property
    def duplicates(self) -> dict[str, str]:
        """Clip -> the first clip with common motion."""
        return find_copies(self.clips)


class TooShortError(InputError):
    """A valid clip has too few frames."""


def survey_folder(root: Root, min_frames: int = 2, strict: bool = False) -> Survey:
    """Read every npz file below a folder. Raises InputError without such files, or if `strict` is set and a
    file is bad."""
    clips: dict[str, ClipRecord] = {}
    firsts: dict[str, np.ndarray] = {}
    marks: dict[str, tuple[MarkedFrames, MarkedFrames]] = {}
    turns: dict[str, MarkedFrames] = {}
    odd: dict[str, str] = {}
    short, content = [], find_clips(root)
    skipped = [SkippedFile(folder, reason) for folder, reason in content.unreadable.items()]
    for file in progress_bar(content.files, "reading"):
        path, name = root / file, get_clip_name(file)
        try:
            _check_name(path, file, clips)
            clip = read_clip(path, name)
            faults = check_plausible(path, clip)
            resampled, method = resample(clip)
            if len(resampled) < min_frames:
                few = f"{len(resampled)} frames at {FPS} Hz"
                raise TooShortError(f"{path}: {few}, fewer than data.min_frames={min_frames}")
        except NoMotionError:  # such as AMASS' shape files
            continue
        except InputError as error:
            if strict:
                raise
            reason = str(error).removeprefix(escape_line_breaks(f"{path}: "))
            skipped.append(SkippedFile(escape_line_breaks(file), reason))
            short += [name] if isinstance(error, TooShortError) else []
        else:
            digests = file_digest(path), _compute_content_digest(clip)
            clips[name] = ClipRecord(name, file, "", "", 0, len(resampled) - 1, *digests, clip.fps, method)
            firsts[name], marks[name] = compute_first_frames(clip), mark_frames(resampled)
            turns[name] = mark_turns(resampled)
            odd |= {name: faults} if faults else {}
    records = list(clips.values())
    records = merge_contents(records, find_resampled_copies(root, records, firsts))
    records = merge_contents(records, find_shared_stretches(root, records, marks))
    records = merge_contents(records, find_conversions(root, records, turns))
    return Survey(tuple(records), tuple(skipped), tuple(short), odd)


def _check_name(path: Path, file: str, clips: dict[str, ClipRecord]) -> None:
    """Raise InputError unless the path is a regular file with a valid and unique clip name."""
    if escape_line_breaks(file) != file:
        raise InputError(f"{path}: the name has control characters; rename the file")
    if get_clip_name(file) in clips:
        raise InputError(f"{path}: {clips[get_clip_name(file)].file} has the same name; rename one of them")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: not a regular file")


def _compute_content_digest(clip: Clip) -> str:
    """Return a digest of the rotations in single precision, or of the translation if no joint turns. So it
    ignores the saved type, the frame rate, and the floor height, which an import measures."""
    poses, trans = (part.reshape(len(clip), -1).astype("<f4") for part in (clip.poses, clip.trans))
    numbers = trans if (poses == poses[0]).all() else poses
    if (numbers == numbers[0]).all():
        return STILL
    return hashlib.sha256((numbers + np.float32(0)).tobytes()).hexdigest()  # + 0, for -0 is 0
