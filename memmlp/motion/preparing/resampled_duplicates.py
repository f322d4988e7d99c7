"""Copies of a clip at another frame rate: the same motion with other frames.

Such a copy begins with the original's first frame and has the same duration, to within a frame of the slower
clip. Pairs of clips for which this is true are read completely, and compared at the times of the slower
clip's frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.motion.body import FPS
from memmlp.motion.clip import LINES, Clip, resample
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.preparing.manifest import STILL, ClipRecord
from memmlp.motion.preparing.several_folders import Root

DEGREES, METRES = 1.0, 0.01  # by which a copy is off at most, on average over frames and joints


def first_frame(clip: Clip) -> np.ndarray:
    """Return rotations and position of the first frame (201,), with which all copies at other rates begin."""
    rotations = Rotation.from_rotvec(clip.poses[0]).as_matrix()
    return np.concatenate([rotations.ravel(), clip.trans[0]]).astype(np.float32)


def resampled_copies(
    root: Root, clips: Sequence[ClipRecord], firsts: Mapping[str, np.ndarray]
) -> Iterator[tuple[ClipRecord, ClipRecord]]:
    """Yield pairs of clips that are one motion at two frame rates.

    Args:
        root: the folder of their files.
        clips: records of sound clips.
        firsts: clip -> its first frame (`first_frame`).
    """
    for pair in _candidates(clips, firsts):
        if _same_motion(*(read_clip(root / clip.file, clip.name) for clip in pair)):
            yield pair


def _candidates(
    clips: Sequence[ClipRecord], firsts: Mapping[str, np.ndarray]
) -> Iterator[tuple[ClipRecord, ClipRecord]]:
    """Yield pairs of moving clips with different rates, but the same duration and the same first frame."""
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
        off = np.abs(begin[near] - begin[index]).max(-1, initial=0.0)
        for other in near[off <= METRES]:  # and as large a difference of a rotation's matrix
            yield moving[index], moving[other]


def _same_motion(one: Clip, other: Clip) -> bool:
    """Return whether two clips with different frame rates are the same motion."""
    slow, fast = sorted((one, other), key=lambda clip: clip.fps)
    fast, _ = resample(fast, slow.fps, LINES)
    frames = min(len(slow), len(fast))
    turns = [Rotation.from_rotvec(clip.poses[:frames].reshape(-1, 3)) for clip in (slow, fast)]
    angle = np.degrees((turns[0].inv() * turns[1]).magnitude().mean())
    way = np.linalg.norm(slow.trans[:frames] - fast.trans[:frames], axis=-1).mean()
    return bool(angle <= DEGREES and way <= METRES)
