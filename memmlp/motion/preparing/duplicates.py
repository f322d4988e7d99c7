"""Finds clips with common motion, and keeps these clips in one group and in one part of a split.

There are four kinds of copies. The first has equal rotations, even if the file was saved again. The second
has a different frame rate, but the same first frame (`find_resampled_copies`). The third shares a stretch of
motion at any rate, such as overlapping cuts, every second frame or a clip played backwards
(`find_shared_stretches`); it needs marked frames, which slow or short motion does not have. The fourth is
another conversion of a take (`find_conversions`). Clips are also compared with mirror images, because some
data sets contain mirrored motion. Clips without motion do not count as copies.

If the split divides all clips in the folder, all copies of a clip get the same part. A published list may
have copies in several parts. Then only the copies in one part stay: test has priority over validation, and
validation over training. So the test set stays as published, and training does not contain its motion. Copies
within one part stay; statistics count their group once."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from memmlp.motion.body import FPS, SWAPPED, make_builtin_rest_joints
from memmlp.motion.clip import Clip, resample
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.geometry import compute_clip_kinematics
from memmlp.motion.preparing.find_clips import Root
from memmlp.motion.preparing.groups import find_root
from memmlp.motion.preparing.manifest import PARTS, STILL, ClipRecord
from memmlp.motion.preparing.splits import Split

FIRST = 0.01  # maximum deviation of rotation matrices in the first frames of copies at different rates
DEGREES, METRES = 1.0, 0.01  # maximum mean deviation of these copies, over frames and joints

REACH = 15  # number of frames at 60 Hz before and after a marked frame that are compared
MOVING = 2.0  # degrees: minimum mean rotation of the joints in a stretch; standing people look alike
ALIKE = 0.2  # degrees: maximum mean deviation; repetitions by one person differ by half a degree
NEAR = 0.05  # maximum distance between the signatures of two marked frames that are compared
SIGNATURE = 24  # numbers per signature
SMOOTH = 2.0  # frames at 60 Hz: standard deviation of the filter for rotations and angular speeds


def assign_parts(
    split: Split, clips: Sequence[ClipRecord]
) -> tuple[dict[str, str | None], dict[str, str], dict[str, str]]:
    """Return the clips' parts, their groups, and the dropped copies: clip -> the copy that stays. Raises
    InputError if the split is impossible."""
    assignment = split.assign([clip.name for clip in clips])
    groups = merge_groups(clips, assignment.groups)
    if split.copies_give_way or groups == assignment.groups:
        parts, gave_way = drop_copies_across_parts(clips, assignment.parts)
        return parts, groups, gave_way
    firsts: dict[str, str] = {}
    for name in sorted(groups):
        firsts.setdefault(groups[name], name)
    drawn = split.assign(sorted(firsts.values())).parts
    return split.limit_group_sizes({name: drawn[firsts[groups[name]]] for name in groups}, groups), groups, {}


def drop_copies_across_parts(
    clips: Sequence[ClipRecord], parts: Mapping[str, str | None]
) -> tuple[dict[str, str | None], dict[str, str]]:
    """Keep the copies of each clip in one part only: test before val before train. Return the new parts, with
    None for dropped clips, and the dropped clips: clip -> the copy that stays."""
    kept, gave_way = dict(parts), {}
    for names in _list_copies(clips):
        last = max((PARTS.index(part) for name in names if (part := parts[name])), default=0)
        staying = [name for name in names if parts[name] == PARTS[last]]
        for name in names:
            if parts[name] not in (None, PARTS[last]):
                kept[name], gave_way[name] = None, staying[0]
    return kept, gave_way


def merge_groups(clips: Sequence[ClipRecord], groups: Mapping[str, str]) -> dict[str, str]:
    """Merge groups with common frames; a merged group has the name of its first group."""
    parents: dict[str, str] = {}
    for names in _list_copies(clips):
        roots = {find_root(parents, groups[name]) for name in names}
        parents |= dict.fromkeys(roots, min(roots))
    return {name: find_root(parents, group) for name, group in groups.items()}


def merge_contents(
    clips: Sequence[ClipRecord], pairs: Iterable[tuple[ClipRecord, ClipRecord]]
) -> list[ClipRecord]:
    """Give the clips of each pair the content of the first clip. Pairs are transitive."""
    parents: dict[str, str] = {}
    for one, other in pairs:
        parents[find_root(parents, other.content)] = find_root(parents, one.content)
    return [replace(clip, content=find_root(parents, clip.content)) for clip in clips]


def _list_copies(clips: Sequence[ClipRecord]) -> list[list[str]]:
    """Return lists of the clips with equal content, sorted by name."""
    by_content = defaultdict(list)
    for clip in clips:
        if clip.content != STILL:
            by_content[clip.content].append(clip.name)
    return [sorted(names) for names in by_content.values() if len(names) > 1]


# Copies at a different frame rate, with equal first frames and durations


def mirror_clip(clip: Clip) -> Clip:
    """Mirror a clip at the plane X = 0, and exchange left and right joints."""
    signs, point_signs = np.array((1, -1, -1), np.float32), np.array((-1, 1, 1), np.float32)
    return replace(clip, poses=clip.poses[:, list(SWAPPED)] * signs, trans=clip.trans * point_signs)


def compute_first_frames(clip: Clip) -> np.ndarray:
    """Return the rotations in the first frame of a clip and of its mirror image (2, 198). Copies at different
    frame rates have equal first frames, but imports may measure different floor heights."""
    start = replace(clip, poses=clip.poses[:1], trans=clip.trans[:1])
    turns = [Rotation.from_rotvec(one.poses[0]).as_matrix().ravel() for one in (start, mirror_clip(start))]
    return np.stack(turns).astype(np.float32)


def find_resampled_copies(
    root: Root, clips: Sequence[ClipRecord], firsts: Mapping[str, np.ndarray]
) -> Iterator[tuple[ClipRecord, ClipRecord]]:
    """Yield pairs of clips with the same motion at different frame rates. `firsts` has clip -> its original
    and mirrored first frame (`compute_first_frames`)."""
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
            for other in near[off <= FIRST]:
                one, two = (read_clip(root / moving[i].file, moving[i].name) for i in (index, other))
                if _is_same_motion(mirror_clip(one) if mirrored else one, two):
                    yield moving[index], moving[other]


def _is_same_motion(one: Clip, other: Clip) -> bool:
    """Compare two clips at the lower of their frame rates."""
    slow, fast = sorted((one, other), key=lambda clip: clip.fps)
    fast, _ = resample(fast, slow.fps)
    frames = min(len(slow), len(fast))
    turns = [Rotation.from_rotvec(clip.poses[:frames].reshape(-1, 3)) for clip in (slow, fast)]
    angle = np.degrees((turns[0].inv() * turns[1]).magnitude().mean())
    apart = slow.trans[:frames] - fast.trans[:frames]
    distance = np.linalg.norm(apart - apart.mean(0), axis=-1).mean()
    return bool(angle <= DEGREES and distance <= METRES)


# Shared stretches: equal sequences of poses, at any time and at any place in the world


class MarkedFrames(NamedTuple):
    """Marked frames of a clip at 60 Hz, or of its mirror image: indices (M,), and weighted sums of their
    smoothed rotations (M, 24), which are similar for similar poses. Frames are marked at the local extrema,
    within a quarter of a second on either side, of a fixed weighted sum. They depend only on the motion, so
    clips that share motion have corresponding marked frames."""

    frames: np.ndarray
    signatures: np.ndarray


def mark_frames(clip: Clip) -> tuple[MarkedFrames, MarkedFrames]:
    """Mark frames of a clip at 60 Hz and of its mirror image, except where there is no motion."""
    original, mirrored = map(compute_local_rotations, (clip, mirror_clip(clip)))
    return _mark_rotations(original), _mark_rotations(mirrored)


def compute_local_rotations(clip: Clip) -> np.ndarray:
    """Return the local rotation matrices (N, 21, 9) of all joints except the root."""
    rotations = Rotation.from_rotvec(clip.poses[:, 1:].reshape(-1, 3)).as_matrix()
    return rotations.reshape(len(clip), -1, 9).astype(np.float32)


def _smooth(turns: np.ndarray) -> np.ndarray:
    """Remove noise, because it differs between two samplings of a take, such as its odd and even frames."""
    margin = round(4 * SMOOTH)  # the motion continues point-symmetrically beyond its ends
    padded = np.pad(turns, ((margin, margin), (0, 0), (0, 0)), "reflect", reflect_type="odd")
    return gaussian_filter1d(padded, SMOOTH, axis=0)[margin:-margin]


def _mark_rotations(turns: np.ndarray) -> MarkedFrames:
    weights = np.random.default_rng(0).standard_normal((189, SIGNATURE)) / np.sqrt(SIGNATURE)
    sums = _smooth(turns).reshape(len(turns), -1) @ weights  # a random projection nearly preserves distances
    extrema = set()
    for signal in (sums[:, 0], -sums[:, 0]):
        extrema |= set(np.flatnonzero(signal == maximum_filter1d(signal, 2 * REACH + 1)))
    inside = sorted(frame for frame in extrema if REACH <= frame < len(turns) - REACH)
    stretches = ((frame, turns[frame - REACH : frame + REACH + 1]) for frame in inside)
    moving = [at for at, each in stretches if _measure_angles(each, turns[at]).max(0).mean() >= MOVING]
    marked = np.array(moving, int)
    return MarkedFrames(marked, _interpolate_extrema(sums, marked).astype(np.float32))


def _interpolate_extrema(sums: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Interpolate sums (N, 24) at the extrema of the first sum, which may lie between two frames. So the
    result (M, 24) does not depend on the sampling times."""
    before, at, after = sums[frames - 1], sums[frames], sums[frames + 1]
    slope, curvature = (after - before) / 2, after - 2 * at + before
    shift = np.divide(-slope[:, 0], curvature[:, 0], out=np.zeros(len(frames)), where=curvature[:, 0] != 0)
    shift = shift.clip(-0.5, 0.5)[:, None]
    return at + shift * slope + shift**2 / 2 * curvature


def _measure_angles(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angles, degrees, between rotations (..., 9). They are accurate only if small."""
    return np.degrees(np.sqrt(((one - other) ** 2).sum(-1) / 2))


def find_shared_stretches(
    root: Root, clips: Sequence[ClipRecord], marks: Mapping[str, tuple[MarkedFrames, MarkedFrames]]
) -> Iterator[tuple[ClipRecord, ClipRecord]]:
    """Yield pairs of clips that share a stretch of motion and have different `content`. `marks` has clip ->
    its original and mirrored marked frames (`mark_frames`). The frames around those with similar signatures
    are compared."""

    @lru_cache(maxsize=16)
    def read_rotations(index: int, mirrored: bool) -> np.ndarray:
        clip = _read_resampled(root, clips[index])
        return _smooth(compute_local_rotations(mirror_clip(clip) if mirrored else clip))

    every = [marks[clip.name][side] for side in (0, 1) for clip in clips]  # originals, then mirror images
    done: set[tuple[int, int]] = set()
    for one, frame, other, other_frame in _pair_marked_frames(every, NEAR):
        two, mirrored = other % len(clips), other >= len(clips)
        pair = min(one, two), max(one, two)
        if one >= len(clips) or pair in done or clips[one].content == clips[two].content:
            continue
        if _has_same_rotations(read_rotations(one, False), frame, read_rotations(two, mirrored), other_frame):
            done.add(pair)
            yield clips[pair[0]], clips[pair[1]]


def _read_resampled(root: Root, record: ClipRecord) -> Clip:
    return resample(read_clip(root / record.file, record.name))[0]


def _pair_marked_frames(
    marks: Sequence[MarkedFrames], distance: float
) -> Iterator[tuple[int, int, int, int]]:
    """Yield pairs of marked frames with signatures up to a distance: the index in `marks`, and the frame."""
    owners = np.repeat(np.arange(len(marks)), [len(one.frames) for one in marks])
    if len(owners):
        frames = np.concatenate([one.frames for one in marks])
        tree = cKDTree(np.concatenate([one.signatures for one in marks]))
        for one, two in np.sort(tree.query_pairs(distance, output_type="ndarray"), axis=1):
            yield int(owners[one]), int(frames[one]), int(owners[two]), int(frames[two])


def _has_same_rotations(one: np.ndarray, frame: int, other: np.ndarray, other_frame: int) -> bool:
    """Return whether two clips have equal rotations around one frame of each clip, forwards or backwards.
    Extrema are flat, so frame indices are uncertain by one. The frames of one clip may lie between the frames
    of the other, so the fraction of a step that fits best is compared."""
    first = one[frame - REACH : frame + REACH + 1]
    near = other[max(other_frame - REACH - 1, 0) : other_frame + REACH + 2]
    for frames in (near, near[::-1]):
        steps = np.diff(frames, axis=0, append=frames[-1:])
        for start in range(len(frames) - len(first) + 1):
            at, step = (numbers[start : start + len(first)] for numbers in (frames, steps))
            part = np.clip(((first - at) * step).sum() / (step**2).sum(), 0, 1)
            if _measure_angles(first, at + part * step).mean() <= ALIKE:
                return True
    return False


BONES = [0, 1, 4, 16, 18, 2, 5, 17, 19]  # pelvis; left, then right hip, knee, shoulder and elbow
SLOW = 0.2  # rad/s, added to speeds before the logarithm
APART = 15  # frames between marked frames, at least
AROUND = np.arange(-30, 31, 3)  # frames around a marked frame that make its signature
VARIED = 0.15  # minimum standard deviation of a signature
TAKES_NEAR = 0.15  # maximum distance between the signatures of marked frames that are compared
TAKE_REACH, SHORTEST = 60, 75  # frames that are compared before and after a marked one; minimum in all
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
    """Yield pairs of clips that are conversions of one take and have different `content`. `marks` has clip ->
    its marked frames (`mark_turns`)."""

    @lru_cache(maxsize=16)
    def bones(index: int) -> np.ndarray:
        clip = _read_resampled(root, clips[index])
        return compute_clip_kinematics(clip, make_builtin_rest_joints())[0][:, BONES]

    done: set[tuple[int, int]] = set()
    every = [marks[clip.name] for clip in clips]
    for one, frame, two, other_frame in _pair_marked_frames(every, TAKES_NEAR):
        if (one, two) in done or clips[one].content == clips[two].content:
            continue
        if _is_same_take(bones(one), frame, bones(two), other_frame):
            done.add((one, two))
            yield clips[one], clips[two]


def _is_same_take(one: np.ndarray, frame: int, other: np.ndarray, other_frame: int) -> bool:
    """Return whether global rotations (N, 9, 3, 3) around two frames differ by constants only."""
    before = min(frame, other_frame, TAKE_REACH)
    after = min(len(one) - frame, len(other) - other_frame, TAKE_REACH)
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
