"""Finds copies that are different conversions of one take, such as its ASF/AMC file and a BVH file.

The bones of two conversions differ, and so do the joint rotations in the clips, by angles that hardly change
over time. The turns of the pelvis are equal. So pelvises with equal angular speeds are found first. Then the
limbs are compared, without the constant part of their differences. Repetitions by one person differ by a
degree or more at the pelvis.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from memmlp.motion.body import FPS, JOINTS, make_builtin_rest_joints
from memmlp.motion.clip import LINES, Clip, resample
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.geometry import compute_clip_kinematics
from memmlp.motion.preparing.duplicates import MarkedFrames
from memmlp.motion.preparing.find_clips import Root
from memmlp.motion.preparing.manifest import ClipRecord

BONES = [JOINTS.index("pelvis")] + [
    JOINTS.index(f"{side}_{joint}")
    for side in ("left", "right")
    for joint in ("hip", "knee", "shoulder", "elbow")
]
SMOOTH = 2.0  # frames: standard deviation of the filter for angular speeds
SLOW = 0.2  # rad/s, added to speeds before the logarithm
APART = 15  # frames between marked frames, at least
AROUND = np.arange(-30, 31, 3)  # frames around a marked frame that make its signature
VARIED = 0.15  # minimum standard deviation of a signature
NEAR = 0.15  # maximum distance between the signatures of marked frames that are compared
REACH, SHORTEST = 60, 75  # frames that are compared before and after a marked frame; minimum of all frames
PELVIS, LIMBS = 0.5, 0.15  # degrees, and fraction of the motion: maximum differences; measured: 0.05 and 0.1


def mark_turns(clip: Clip) -> MarkedFrames:
    """Mark the fastest turns of the pelvis in a clip at 60 Hz. Signatures (M, 21) are speeds around them."""
    root = Rotation.from_rotvec(clip.poses[:, 0])
    speeds = (root[:-1].inv() * root[1:]).magnitude() * FPS
    logs = np.log(gaussian_filter1d(speeds, SMOOTH) + SLOW) if len(speeds) else speeds
    marks = np.flatnonzero(logs == maximum_filter1d(logs, 2 * APART + 1))
    marks = marks[(marks + AROUND[0] >= 0) & (marks + AROUND[-1] < len(logs))]
    signatures = logs[marks[:, None] + AROUND].astype(np.float32)
    varied = signatures.std(1) > VARIED
    return MarkedFrames(marks[varied], signatures[varied])


def find_conversions(
    root: Root, clips: Sequence[ClipRecord], marks: Mapping[str, MarkedFrames]
) -> Iterator[tuple[ClipRecord, ClipRecord]]:
    """Yield pairs of clips that are conversions of one take and have different `content`.

    Args:
        root: the folder of the clips.
        clips: records of valid clips.
        marks: clip -> its marked frames (`mark_turns`).
    """
    owners = np.repeat(np.arange(len(clips)), [len(marks[clip.name].frames) for clip in clips])
    if not len(owners):
        return

    @lru_cache(maxsize=16)
    def bones(index: int) -> np.ndarray:
        clip = resample(read_clip(root / clips[index].file, clips[index].name), interpolation=LINES)[0]
        return compute_clip_kinematics(clip, make_builtin_rest_joints())[0][:, BONES]

    frames = np.concatenate([marks[clip.name].frames for clip in clips])
    signatures = np.concatenate([marks[clip.name].signatures for clip in clips])
    done: set[tuple[int, int]] = set()
    for mark, other in np.sort(cKDTree(signatures).query_pairs(NEAR, output_type="ndarray"), axis=1):
        one, two = int(owners[mark]), int(owners[other])
        if (one, two) in done or clips[one].content == clips[two].content:
            continue
        if _is_same_take(bones(one), frames[mark], bones(two), frames[other]):
            done.add((one, two))
            yield clips[one], clips[two]


def _is_same_take(one: np.ndarray, frame: int, other: np.ndarray, other_frame: int) -> bool:
    """Return whether global rotations (N, 9, 3, 3) around two frames differ by constants only."""
    before = min(frame, other_frame, REACH)
    after = min(len(one) - frame, len(other) - other_frame, REACH)
    if before + after < SHORTEST:
        return False
    here = one[frame - before : frame + after]
    there = other[other_frame - before : other_frame + after]
    differences = _measure_changes(here.swapaxes(-1, -2) @ there)
    return bool(differences[0] < PELVIS and np.median(differences / _measure_changes(here)) < LIMBS)


def _measure_changes(rotations: np.ndarray) -> np.ndarray:
    """Return the median angles (J,), degrees, between rotations (N, J, 3, 3) and their means."""
    means = [Rotation.from_matrix(joint).mean().as_matrix() for joint in rotations.swapaxes(0, 1)]
    distances = np.linalg.norm(rotations - np.array(means), axis=(-2, -1))
    return np.degrees(2 * np.arcsin(np.clip(np.median(distances, axis=0) / np.sqrt(8), 1e-6, 1)))
