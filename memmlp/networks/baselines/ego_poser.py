"""EgoPoser (Jiang et al., ECCV 2024): AvatarPoser's encoder over a fast and a slow view of a longer window.

Its mask of hands out of sight is left out, since all trackers are seen here, and so is its head for the
body's shape, since all bodies here have the mean one.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from memmlp.motion.body import SPARSE_DIM, SPARSE_POSITION, TRACKED
from memmlp.motion.network_coordinates import HeadRelative
from memmlp.networks.baselines.avatar_poser import AvatarPoser

PLACES = 2 * len(TRACKED)  # components of the trackers' places on the floor


def beside_head(sparse: Tensor) -> Tensor:
    """Return inputs (..., 54) with positions on the floor relative to the head in the same frame."""
    space = HeadRelative()
    return space.sparse_in(sparse, space.origin(sparse))


def places(sparse: Tensor) -> Tensor:
    """Return the trackers' positions on the floor (..., 6), from inputs (..., 54)."""
    return sparse[..., SPARSE_POSITION].unflatten(-1, (len(TRACKED), 3))[..., :2].flatten(-2)


class EgoPoser(AvatarPoser):
    """AvatarPoser's encoder over the sum of two views: the window's newer half, and its every second frame.

    It has 4,126,340 parameters at the paper's sizes (T = 80, otherwise AvatarPoser's); the released code has
    a further layer of 7,808 that nothing uses. Positions are relative to the point of the floor below the
    head in the same frame, and how far these moved since the window's first frame is appended to each frame's
    inputs: the head's not at all. In the released code the hands' positions and movements are the world's
    (docs/readings.md).
    """

    inputs: ClassVar[int] = SPARSE_DIM + PLACES

    def rotations(self, encoded: Tensor) -> Tensor:
        """Map windows (B, T, 54) to their last frames' rotations (B, 132), both in network space."""
        local = beside_head(encoded)
        moved = places(local) - places(local[:, :1])
        slow, fast = self.views(torch.cat([local, moved], -1))
        return self.encode(self.embedding(slow) + self.embedding(fast))

    @staticmethod
    def views(window: Tensor) -> tuple[Tensor, Tensor]:
        """Return the slow and the fast view of a window (..., T, n): half of its frames each."""
        slow = window[..., ::2, :]
        return slow, window[..., -slow.shape[-2] :, :]
