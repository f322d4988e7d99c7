"""Stretches that two clips share: overlapping cuts of a recording, copies in another precision or mirrored.

Such clips have the same poses for a while, wherever in the clips and in the world that is. So a few frames of
each clip are marked by their content alone, which marks the same ones in both: those at which a fixed sum of
the rotations is largest or smallest for a quarter of a second on either side. Where marked frames of two
clips are alike, the frames around them are compared. Some data sets ship their motion mirrored, too, and
would test on what they train on; so each clip is compared as it is and as a mirror shows it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from memmlp.motion.body import SWAPPED
from memmlp.motion.clip import LINES, Clip, resample
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.preparing.manifest import ClipRecord
from memmlp.motion.preparing.several_folders import Root

REACH = 15  # frames at 60 Hz on either side of a marked one, which are compared
MOVING = 2.0  # degrees by which joints turn meanwhile on average; who stands still is like many others
ALIKE = (
    0.2  # degrees by which the joints differ on average; repetitions by one person differ by half a degree
)
NEAR = 0.05  # distance of two marked frames' signatures, from which on nobody compares them
SIGNATURE = 24  # numbers
OTHERS = np.array(SWAPPED[1:]) - 1  # of the joints without the root, which the mirror has in their places
SIGNS = np.outer((-1, 1, 1), (-1, 1, 1)).reshape(9).astype(np.float32)  # of S R S with S = diag(-1, 1, 1)


class Marked(NamedTuple):
    """The marked frames of a clip, or of its mirror image.

    Attributes:
        frames: their numbers (M,) at 60 Hz.
        signatures: sums of their rotations (M, 24), of which frames that are alike have similar ones.
    """

    frames: np.ndarray
    signatures: np.ndarray


class Marks(NamedTuple):
    """The marked frames of a clip as it is, and of its mirror image."""

    plain: Marked
    mirrored: Marked


def marks(clip: Clip) -> Marks:
    """Return the marked frames, around which there is motion, of a clip at 60 Hz and of its mirror image."""
    turns = _turns(clip)
    return Marks(_marked(turns), _marked(in_mirror(turns)))


def in_mirror(turns: np.ndarray) -> np.ndarray:
    """Return local rotations (N, 21, 9) of all joints but the root as a mirror shows them."""
    return turns[:, OTHERS] * SIGNS


def _marked(turns: np.ndarray) -> Marked:
    sums = turns.reshape(len(turns), -1) @ _weights()
    found = set()
    for signal in (sums[:, 0], -sums[:, 0]):
        found |= set(np.flatnonzero(signal == maximum_filter1d(signal, 2 * REACH + 1)))
    inside = sorted(frame for frame in found if REACH <= frame < len(turns) - REACH)
    moving = [frame for frame in inside if _moves(turns[frame - REACH : frame + REACH + 1])]
    return Marked(np.array(moving, int), sums[moving].astype(np.float32))


def sharing(
    root: Root, clips: Sequence[ClipRecord], marked: Mapping[str, Marks]
) -> Iterator[tuple[ClipRecord, ClipRecord]]:
    """Yield pairs of clips that share a stretch and are not known as copies; a pair may come again.

    Args:
        root: the folder of their files.
        clips: records of sound clips.
        marked: clip -> its marked frames.
    """
    plain, mirrored = (_together([marked[clip.name][side] for clip in clips]) for side in (0, 1))
    if not len(plain.owners):
        return

    @lru_cache(maxsize=16)
    def turns(index: int) -> np.ndarray:
        clip = clips[index]
        return _turns(resample(read_clip(root / clip.file, clip.name), interpolation=LINES)[0])

    done: set[tuple[int, int]] = set()
    for others, seen in ((plain, turns), (mirrored, lambda index: in_mirror(turns(index)))):
        for mark, other in _near(plain, others):
            one, two = int(plain.owners[mark]), int(others.owners[other])
            pair = min(one, two), max(one, two)
            if pair in done or clips[one].content == clips[two].content:
                continue
            if _alike(turns(one), plain.frames[mark], seen(two), others.frames[other]):
                done.add(pair)
                yield clips[pair[0]], clips[pair[1]]


class _Together(NamedTuple):
    """The marked frames of all clips: each one's clip, its number there, and the tree of their signatures."""

    owners: np.ndarray
    frames: np.ndarray
    tree: cKDTree


def _together(every: Sequence[Marked]) -> _Together:
    owners = np.repeat(np.arange(len(every)), [len(one.frames) for one in every])
    signatures = np.concatenate([one.signatures for one in every])
    return _Together(owners, np.concatenate([one.frames for one in every]), cKDTree(signatures))


def _near(one: _Together, other: _Together) -> np.ndarray:
    """Return pairs (P, 2) of marks with signatures that are near each other, in order; each only once."""
    if one is other:
        pairs = np.sort(one.tree.query_pairs(NEAR, output_type="ndarray"), axis=1)
    else:
        found = one.tree.query_ball_tree(other.tree, NEAR)
        pairs = np.array([(mark, near) for mark, those in enumerate(found) for near in those], int)
    return pairs.reshape(-1, 2)


def _weights() -> np.ndarray:
    """Return the matrix (189, 24) from a frame's rotations to its signature. It nearly keeps distances."""
    return np.random.default_rng(0).standard_normal((189, SIGNATURE)) / np.sqrt(SIGNATURE)


def _turns(clip: Clip) -> np.ndarray:
    """Return the local rotations (N, 21, 9) of all joints but the root, which tells where a person faces."""
    rotations = Rotation.from_rotvec(clip.poses[:, 1:].reshape(-1, 3)).as_matrix()
    return rotations.reshape(len(clip), -1, 9).astype(np.float32)


def _degrees(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angles between rotations (..., 9), as far as these are small."""
    return np.degrees(np.sqrt(((one - other) ** 2).sum(-1) / 2))


def _moves(stretch: np.ndarray) -> bool:
    """Return whether a stretch (31, 21, 9) moves away from the frame in its middle."""
    return bool(_degrees(stretch, stretch[REACH]).max(0).mean() >= MOVING)


def _alike(one: np.ndarray, at: int, other: np.ndarray, there: int) -> bool:
    """Return whether two clips have the same rotations around one frame of each.

    A frame's number is uncertain by one, since extrema are flat.
    """
    first = one[at - REACH : at + REACH + 1]
    begins = (max(there + shift - REACH, 0) for shift in (-1, 0, 1))
    stretches = (other[begin : begin + len(first)] for begin in begins)
    return any(len(first) == len(second) and _degrees(first, second).mean() <= ALIKE for second in stretches)
