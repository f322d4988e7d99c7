"""Motion seen in a mirror: left and right change places, as an augmentation of training data."""

from __future__ import annotations

import torch
from torch import Tensor

from memmlp.motion.body import FRAME_DIM, SWAPPED, TRACKED
from memmlp.motion.dataset import MotionDataset

SIXD_SIGNS = (1.0, -1.0, -1.0, -1.0, 1.0, 1.0)  # the first two columns of S R S with S = diag(-1, 1, 1)
POINT_SIGNS = (-1.0, 1.0, 1.0)  # S p


TRACKED_SWAPPED = tuple(TRACKED.index(SWAPPED[joint]) for joint in TRACKED)


def _layout() -> tuple[Tensor, Tensor]:
    """Return the source (252,) of each of a frame's features in the mirror, and its sign."""
    sources, signs = torch.arange(FRAME_DIM), torch.ones(FRAME_DIM)
    start = 0
    for joints, of_each in (
        *((TRACKED_SWAPPED, part) for part in (SIXD_SIGNS, SIXD_SIGNS, POINT_SIGNS, POINT_SIGNS)),
        *((SWAPPED, part) for part in (SIXD_SIGNS, POINT_SIGNS)),
    ):
        size = len(joints) * len(of_each)
        block = torch.arange(start, start + size).view(len(joints), -1)
        sources[start : start + size] = block[list(joints)].flatten()
        signs[start : start + size] = torch.tensor(of_each * len(joints))
        start += size
    return sources, signs


SOURCES, SIGNS = _layout()


def mirrored(frames: Tensor) -> Tensor:
    """Mirror world frames [X | Theta] (..., 252) at the plane X = 0, with left and right exchanged.

    If the body's rest pose is not symmetric, the mirrored motion is that of the mirrored body.
    """
    return frames[..., SOURCES.to(frames.device)] * SIGNS.to(frames)


class MirroredDataset(MotionDataset):
    """Each clip of a dataset twice: first all clips as they are, then all clips mirrored.

    The frames are stored once; frames of a mirrored clip are mirrored when they are read.
    """

    def __init__(self, plain: MotionDataset):
        names = [*plain.names, *(f"{name} (mirrored)" for name in plain.names)]
        sources = plain.sources and [*plain.sources] * 2
        starts, lengths = plain.starts.repeat(2), plain.lengths.repeat(2)
        super().__init__(plain.frames, starts, lengths, names, [*plain.groups] * 2, sources)

    def stretches(self, clip: Tensor, end: Tensor, length: int) -> Tensor:
        """Return frames (B, length, 252) that end with frame `end` of each clip; see MotionDataset."""
        plain = super().stretches(clip, end, length)
        turned = (clip >= len(self) // 2).to(plain.device)
        return torch.where(turned[:, None, None], mirrored(plain), plain)

    def clip(self, index: int) -> Tensor:
        """Return all frames (N, 252) of a clip."""
        plain = super().clip(index)
        return mirrored(plain) if index >= len(self) // 2 else plain
