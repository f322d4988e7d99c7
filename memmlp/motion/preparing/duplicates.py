"""Clips that share motion: they never lie in two parts of a split, and they form one group.

Copies are found by their frames, so a file that was saved again is a copy. Two further kinds are found in
the motion: copies at another frame rate (`find_resampled_copies`), and clips that share a stretch, such as
overlapping cuts or a clip played backwards (`find_shared_stretches`). Both also compare clips with mirror
images, since some data sets contain their motion mirrored. Clips without motion do not count as copies.

If the split divides all clips in the folder, copies are drawn together, like any group. A published list may
have copies in several parts: then those in training give way to those in validation, and both to those in
test. The test set stays as published, and nothing in it was seen in training. Copies within one part stay;
statistics count their group once.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from memmlp.motion.body import FPS, SWAPPED
from memmlp.motion.clip import LINES, Clip, resample
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.preparing.find_clips import Root
from memmlp.motion.preparing.groups import find_root
from memmlp.motion.preparing.manifest import PARTS, STILL, ClipRecord
from memmlp.motion.preparing.splits import Split

DEGREES, METRES = 1.0, 0.01  # largest mean deviation of a copy at another rate, over frames and joints

REACH = 15  # frames at 60 Hz on either side of a marked one, which are compared
MOVING = 2.0  # degrees: least mean turn of the joints in a stretch; people who stand still look alike
ALIKE = 0.2  # degrees: largest mean deviation; repetitions by one person differ by half a degree
NEAR = 0.05  # largest distance of the signatures of two marked frames that are compared
SIGNATURE = 24  # numbers
MIRRORED = np.array(SWAPPED[1:]) - 1  # of the joints without the root, those in their places in a mirror
SIGNS = np.outer((-1, 1, 1), (-1, 1, 1)).reshape(9).astype(np.float32)  # of S R S with S = diag(-1, 1, 1)


def assign_parts(
    split: Split, clips: Sequence[ClipRecord]
) -> tuple[dict[str, str | None], dict[str, str], dict[str, str]]:
    """Return each clip's part and group, and for each dropped copy the clip that was kept.

    Raises:
        InputError: if the split is impossible.
    """
    assignment = split.assign([clip.name for clip in clips])
    groups = merge_groups(clips, assignment.groups)
    if split.listed or groups == assignment.groups:
        parts, gave_way = keep_one_part(clips, assignment.parts)
        return parts, groups, gave_way
    firsts: dict[str, str] = {}
    for name in sorted(groups):
        firsts.setdefault(groups[name], name)
    drawn = split.assign(sorted(firsts.values())).parts
    return split.limit({name: drawn[firsts[groups[name]]] for name in groups}, groups), groups, {}


def keep_one_part(
    clips: Sequence[ClipRecord], parts: Mapping[str, str | None]
) -> tuple[dict[str, str | None], dict[str, str]]:
    """Return parts without common frames, and each dropped clip -> its copy that stays.

    Args:
        clips: the clips with their content.
        parts: each clip's part, or None.
    """
    kept, gave_way = dict(parts), {}
    for names in _copies(clips):
        last = max((PARTS.index(part) for name in names if (part := parts[name])), default=0)
        staying = [name for name in names if parts[name] == PARTS[last]]
        for name in names:
            if parts[name] not in (None, PARTS[last]):
                kept[name], gave_way[name] = None, staying[0]
    return kept, gave_way


def merge_groups(clips: Sequence[ClipRecord], groups: Mapping[str, str]) -> dict[str, str]:
    """Return each clip's group; groups that share frames are merged, and named after the first of them."""
    parents: dict[str, str] = {}
    for names in _copies(clips):
        roots = {find_root(parents, groups[name]) for name in names}
        parents |= dict.fromkeys(roots, min(roots))
    return {name: find_root(parents, group) for name, group in groups.items()}


def merge_contents(
    clips: Sequence[ClipRecord], pairs: Iterable[tuple[ClipRecord, ClipRecord]]
) -> list[ClipRecord]:
    """Return the clips such that those of a pair have one content, the first one's; pairs are transitive."""
    parents: dict[str, str] = {}
    for one, other in pairs:
        parents[find_root(parents, other.content)] = find_root(parents, one.content)
    return [replace(clip, content=find_root(parents, clip.content)) for clip in clips]


def _copies(clips: Sequence[ClipRecord]) -> list[list[str]]:
    """Return the sorted names of clips with the same frames, for all frames that occur more than once."""
    by_content = defaultdict(list)
    for clip in clips:
        if clip.content != STILL:
            by_content[clip.content].append(clip.name)
    return [sorted(names) for names in by_content.values() if len(names) > 1]


# Copies at another frame rate: they begin with the same frame and have the same duration


def mirror_clip(clip: Clip) -> Clip:
    """Return a clip mirrored at the plane X = 0, with left and right joints exchanged."""
    turns, place = np.array((1, -1, -1), np.float32), np.array((-1, 1, 1), np.float32)
    return replace(clip, poses=clip.poses[:, list(SWAPPED)] * turns, trans=clip.trans * place)


def first_frames(clip: Clip) -> np.ndarray:
    """Return rotations and position of the first frame; copies at other rates begin with the same frame.

    Returns:
        (2, 201), for the clip and for its mirror image.
    """
    start = replace(clip, poses=clip.poses[:1], trans=clip.trans[:1])
    rows = []
    for one in (start, mirror_clip(start)):
        rotations = Rotation.from_rotvec(one.poses[0]).as_matrix()
        rows.append(np.concatenate([rotations.ravel(), one.trans[0]]).astype(np.float32))
    return np.stack(rows)


def find_resampled_copies(
    root: Root, clips: Sequence[ClipRecord], firsts: Mapping[str, np.ndarray]
) -> Iterator[tuple[ClipRecord, ClipRecord]]:
    """Yield pairs of clips that are one motion at two frame rates.

    Args:
        root: the folder of their files.
        clips: records of sound clips.
        firsts: clip -> its first frame, as it is and mirrored (`first_frames`).
    """
    moving = sorted((clip for clip in clips if clip.content != STILL), key=lambda clip: clip.length)
    if len({clip.fps for clip in moving}) < 2:
        return
    rates, lengths = (np.array([getattr(clip, key) for clip in moving]) for key in ("fps", "length"))
    starts = np.stack([firsts[clip.name] for clip in moving])
    ends = np.searchsorted(lengths, lengths + FPS / rates.min() + 1, "right")
    for index, end in enumerate(ends):
        near = np.arange(index + 1, end)
        slower = np.minimum(rates[near], rates[index])
        near = near[(rates[near] != rates[index]) & (lengths[near] - lengths[index] <= FPS / slower + 1)]
        for mirrored in (False, True):
            off = np.abs(starts[near, 0] - starts[index, int(mirrored)]).max(-1, initial=0.0)
            for other in near[off <= METRES]:  # the same bound for entries of rotation matrices
                one, two = (read_clip(root / moving[i].file, moving[i].name) for i in (index, other))
                if _is_same_motion(mirror_clip(one) if mirrored else one, two):
                    yield moving[index], moving[other]


def _is_same_motion(one: Clip, other: Clip) -> bool:
    """Compare two clips at the times of the slower clip's frames."""
    slow, fast = sorted((one, other), key=lambda clip: clip.fps)
    fast, _ = resample(fast, slow.fps, LINES)
    frames = min(len(slow), len(fast))
    turns = [Rotation.from_rotvec(clip.poses[:frames].reshape(-1, 3)) for clip in (slow, fast)]
    angle = np.degrees((turns[0].inv() * turns[1]).magnitude().mean())
    distance = np.linalg.norm(slow.trans[:frames] - fast.trans[:frames], axis=-1).mean()
    return bool(angle <= DEGREES and distance <= METRES)


# Shared stretches: the same poses for a while, wherever in the clips and in the world


class Marks(NamedTuple):
    """The marked frames of a clip at 60 Hz, or of its mirror image.

    The marks depend only on the motion, so two clips with common motion have the same marks: the frames where
    a fixed sum of the rotations is largest or smallest for a quarter of a second on either side.

    Attributes:
        frames: their numbers (M,).
        signatures: sums of their rotations (M, 24), which are similar for similar frames.
    """

    frames: np.ndarray
    signatures: np.ndarray


def mark_frames(clip: Clip) -> tuple[Marks, Marks]:
    """Return the marked frames, around which there is motion, of a clip at 60 Hz and of its mirror image."""
    turns = local_turns(clip)
    return _mark_turns(turns), _mark_turns(mirror_turns(turns))


def local_turns(clip: Clip) -> np.ndarray:
    """Return the local rotations (N, 21, 9) of all joints but the root."""
    rotations = Rotation.from_rotvec(clip.poses[:, 1:].reshape(-1, 3)).as_matrix()
    return rotations.reshape(len(clip), -1, 9).astype(np.float32)


def mirror_turns(turns: np.ndarray) -> np.ndarray:
    """Return local rotations (N, 21, 9) of all joints but the root as a mirror shows them."""
    return turns[:, MIRRORED] * SIGNS


def _mark_turns(turns: np.ndarray) -> Marks:
    weights = np.random.default_rng(0).standard_normal((189, SIGNATURE)) / np.sqrt(SIGNATURE)
    sums = turns.reshape(len(turns), -1) @ weights  # nearly keeps distances
    extrema = set()
    for signal in (sums[:, 0], -sums[:, 0]):
        extrema |= set(np.flatnonzero(signal == maximum_filter1d(signal, 2 * REACH + 1)))
    inside = sorted(frame for frame in extrema if REACH <= frame < len(turns) - REACH)
    stretches = ((frame, turns[frame - REACH : frame + REACH + 1]) for frame in inside)
    moving = [frame for frame, each in stretches if _degrees(each, turns[frame]).max(0).mean() >= MOVING]
    return Marks(np.array(moving, int), _interpolate_extrema(sums, np.array(moving, int)).astype(np.float32))


def _interpolate_extrema(sums: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Return sums (N, 24) at the extrema of the first one (M, 24), which may lie between two frames.

    So they do not depend on the times at which the motion was sampled.
    """
    before, at, after = sums[frames - 1], sums[frames], sums[frames + 1]
    slope, curvature = (after - before) / 2, after - 2 * at + before
    shift = np.divide(-slope[:, 0], curvature[:, 0], out=np.zeros(len(frames)), where=curvature[:, 0] != 0)
    shift = shift.clip(-0.5, 0.5)[:, None]
    return at + shift * slope + shift**2 / 2 * curvature


def _degrees(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angles between rotations (..., 9), accurate if they are small."""
    return np.degrees(np.sqrt(((one - other) ** 2).sum(-1) / 2))


def find_shared_stretches(
    root: Root, clips: Sequence[ClipRecord], marks: Mapping[str, tuple[Marks, Marks]]
) -> Iterator[tuple[ClipRecord, ClipRecord]]:
    """Yield pairs of clips that share a stretch and do not yet have the same content.

    Where marked frames of two clips have similar signatures, the frames around them are compared.

    Args:
        root: the folder of their files.
        clips: records of sound clips.
        marks: clip -> its marked frames (`mark_frames`).
    """

    @lru_cache(maxsize=16)
    def turns(index: int) -> np.ndarray:
        clip = read_clip(root / clips[index].file, clips[index].name)
        return local_turns(resample(clip, interpolation=LINES)[0])

    every = [marks[clip.name][side] for side in (0, 1) for clip in clips]  # as they are, then mirrored
    owners = np.repeat(np.arange(len(every)), [len(one.frames) for one in every])
    if not len(owners):
        return
    frames = np.concatenate([one.frames for one in every])
    near = cKDTree(np.concatenate([one.signatures for one in every])).query_pairs(NEAR, output_type="ndarray")
    done: set[tuple[int, int]] = set()
    for mark, other in np.sort(near, axis=1):
        one, mirrored = int(owners[mark]), int(owners[other]) >= len(clips)
        two = int(owners[other]) - len(clips) * mirrored
        pair = min(one, two), max(one, two)
        if one >= len(clips) or pair in done or clips[one].content == clips[two].content:
            continue
        seen = mirror_turns(turns(two)) if mirrored else turns(two)
        if _are_alike(turns(one), frames[mark], seen, frames[other]):
            done.add(pair)
            yield clips[pair[0]], clips[pair[1]]


def _are_alike(one: np.ndarray, frame: int, other: np.ndarray, other_frame: int) -> bool:
    """Return whether two clips have the same rotations around one frame of each, forwards or backwards.

    A frame's number is uncertain by one, since extrema are flat. The frames of one clip may lie between those
    of the other, if both were reduced from a higher rate.
    """
    first = one[frame - REACH : frame + REACH + 1]
    near = other[max(other_frame - REACH - 1, 0) : other_frame + REACH + 2]
    between = (near[1:] + near[:-1]) / 2
    return any(
        _degrees(first, frames[start : start + len(first)]).mean() <= ALIKE
        for frames in (near, near[::-1], between, between[::-1])
        for start in range(len(frames) - len(first) + 1)
    )
