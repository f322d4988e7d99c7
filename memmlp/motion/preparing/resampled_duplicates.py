"""Copies of a clip at another frame rate, mirrored or not: the same motion with other frames.

Such a copy begins with the original's first frame, or with its mirror image, and has the same duration, to
within a frame of the slower clip. Pairs of clips for which this is true are read completely, and compared at
the times of the slower clip's frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.motion.body import FPS, SWAPPED
from memmlp.motion.clip import LINES, Clip, resample
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.preparing.manifest import STILL, ClipRecord
from memmlp.motion.preparing.several_folders import Root

DEGREES, METRES = 1.0, 0.01  # by which a copy is off at most, on average over frames and joints


def mirrored_clip(clip: Clip) -> Clip:
    """Return a clip as it is mirrored at the plane X = 0, with left and right joints exchanged."""
    turns, place = np.array((1, -1, -1), np.float32), np.array((-1, 1, 1), np.float32)
    return replace(clip, poses=clip.poses[:, list(SWAPPED)] * turns, trans=clip.trans * place)


def first_frames(clip: Clip) -> np.ndarray:
    """Return rotations and position of the first frame, with which all copies at other rates begin.

    Returns:
        Of the clip as it is and of its mirror image (2, 201).
    """
    begin = replace(clip, poses=clip.poses[:1], trans=clip.trans[:1])
    return np.stack([_first_frame(one) for one in (begin, mirrored_clip(begin))])


def _first_frame(clip: Clip) -> np.ndarray:
    rotations = Rotation.from_rotvec(clip.poses[0]).as_matrix()
    return np.concatenate([rotations.ravel(), clip.trans[0]]).astype(np.float32)


def resampled_copies(
    root: Root, clips: Sequence[ClipRecord], firsts: Mapping[str, np.ndarray]
) -> Iterator[tuple[ClipRecord, ClipRecord]]:
    """Yield pairs of clips that are one motion at two frame rates.

    Args:
        root: the folder of their files.
        clips: records of sound clips.
        firsts: clip -> its first frame, as it is and mirrored (`first_frames`).
    """
    for one, other, mirrored in _candidates(clips, firsts):
        first, second = (read_clip(root / clip.file, clip.name) for clip in (one, other))
        if _same_motion(mirrored_clip(first) if mirrored else first, second):
            yield one, other


def _candidates(
    clips: Sequence[ClipRecord], firsts: Mapping[str, np.ndarray]
) -> Iterator[tuple[ClipRecord, ClipRecord, bool]]:
    """Yield pairs of moving clips with different rates, but the same duration and the same first frame.

    With each pair comes whether the first frames are the same with one of the clips mirrored.
    """
    moving = sorted((clip for clip in clips if clip.content != STILL), key=lambda clip: clip.length)
    if len({clip.fps for clip in moving}) < 2:
        return
    rates, lengths = (np.array([getattr(clip, key) for clip in moving]) for key in ("fps", "length"))
    begin = np.stack([firsts[clip.name] for clip in moving])
    ends = np.searchsorted(lengths, lengths + FPS / rates.min() + 1, "right")
    for index, end in enumerate(ends):
        near = np.arange(index + 1, end)
        slower = np.minimum(rates[near], rates[index])
        near = near[(rates[near] != rates[index]) & (lengths[near] - lengths[index] <= FPS / slower + 1)]
        for mirrored in (False, True):
            off = np.abs(begin[near, 0] - begin[index, int(mirrored)]).max(-1, initial=0.0)
            for other in near[off <= METRES]:  # and as large a difference of a rotation's matrix
                yield moving[index], moving[other], mirrored


def _same_motion(one: Clip, other: Clip) -> bool:
    """Return whether two clips with different frame rates are the same motion."""
    slow, fast = sorted((one, other), key=lambda clip: clip.fps)
    fast, _ = resample(fast, slow.fps, LINES)
    frames = min(len(slow), len(fast))
    turns = [Rotation.from_rotvec(clip.poses[:frames].reshape(-1, 3)) for clip in (slow, fast)]
    angle = np.degrees((turns[0].inv() * turns[1]).magnitude().mean())
    way = np.linalg.norm(slow.trans[:frames] - fast.trans[:frames], axis=-1).mean()
    return bool(angle <= DEGREES and way <= METRES)
