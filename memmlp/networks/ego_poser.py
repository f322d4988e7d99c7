"""EgoPoser (Jiang et al., ECCV 2024): AvatarPoser's encoder over a fast and a slow view of a longer window.

Its mask of hands out of sight is left out, since all trackers are seen here, and so is its head for the
body's shape, since all bodies here have the mean one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from memmlp.common.components import component
from memmlp.common.settings import at_least, setting
from memmlp.motion.body import SPARSE_DIM, SPARSE_POSITION, TRACKED
from memmlp.motion.network_coordinates import HeadRelative
from memmlp.networks.avatar_poser import AvatarPoser, AvatarPoserSettings
from memmlp.networks.motion_model import State, StreamingGraph, fill_past
from memmlp.networks.transformer import EncoderLayer, encode_newest_frame

PLACES = 2 * len(TRACKED)  # components of the trackers' places on the floor


def center_on_head(sparse: Tensor) -> Tensor:
    """Return inputs (..., 54) with positions on the floor relative to the head in the same frame."""
    space = HeadRelative()
    return space.sparse_in(sparse, space.origin(sparse))


def select_places(sparse: Tensor) -> Tensor:
    """Return the trackers' positions on the floor (..., 6), from inputs (..., 54)."""
    return sparse[..., SPARSE_POSITION].unflatten(-1, (len(TRACKED), 3))[..., :2].flatten(-2)


class EgoPoserGraph(StreamingGraph):
    """EgoPoser's streaming graph, which carries the embedding's output for each frame, in order of time.

    At every step the slow view pairs other frames, so nothing after the embedding can be carried. The
    movement since the window's first frame enters linearly, so the first frame's contribution is subtracted
    from the sum.
    """

    float32_modules = ("model.embedding", "model.orientation", "model.rotation")
    model: EgoPoser

    def build(self, model: Any) -> None:
        self.model, self.layers = model, cast(list[EncoderLayer], list(model.layers))

    def windows(self) -> State:
        """Return zeros (T - 1, n): each earlier frame's embedding (n = d) and places on the floor (n = 6)."""
        sizes = {"embedded": self.model.embedding.out_features, "places": PLACES}
        return {name: torch.zeros(self.frames - 1, size) for name, size in sizes.items()}

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        local = center_on_head(self.normalizer.encode_sparse(sparse, self.normalizer.origin(sparse)))
        place = select_places(local)
        entering = {"embedded": self.model.embedding(torch.cat([local, place], -1)), "places": place}
        window = {
            name: torch.cat([fill_past(state[name], frame, fresh), frame]) for name, frame in entering.items()
        }
        slow, fast = self.model.make_views(window["embedded"])
        first = F.linear(window["places"][:1], self.model.embedding.weight[:, SPARSE_DIM:])
        newest = encode_newest_frame(self.layers, slow + fast - 2 * first)
        kept = {name: frames[1:] for name, frames in window.items()}
        return self.normalizer.posed(self.model.read(newest), sparse), kept


@component("model", "ego_poser", version=2, builds="EgoPoser")
@dataclass
class EgoPoserSettings(AvatarPoserSettings):
    """EgoPoser (Jiang et al. 2024): AvatarPoser's encoder over a fast and a slow view of a longer window.

    Loss and features are those of its released code, except for the hands' positions, which are its paper's
    (docs/readings.md). Training is this project's, as AvatarPoser's is.
    """

    # T, the frames of a window; the encoder sees half as many
    frames: int = setting(at_least(2), tiny=20, small=80, paper=80)

    defaults: ClassVar = {"loss": "ego_poser"}

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        """Yield why the network cannot be used; see Settings."""
        yield from super().problems(config)
        normalizer = config["normalizer"]
        if normalizer["z_scores"] and normalizer["coordinates"] == "world":
            yield (
                "normalizer.z_scores=true: must be false with normalizer.coordinates=world, since "
                "model=ego_poser subtracts the head position"
            )


class EgoPoser(AvatarPoser):
    """AvatarPoser's encoder over the sum of two views: the window's newer half, and its every second frame.

    It has 4,126,340 parameters at the paper's sizes (T = 80, otherwise AvatarPoser's); the released code has
    a further layer of 7,808 that nothing uses. Positions are relative to the point of the floor below the
    head in the same frame, and how far these moved since the window's first frame is appended to each frame's
    inputs: the head's not at all. In the released code the hands' positions and movements are the world's
    (docs/readings.md).
    """

    graph = EgoPoserGraph
    inputs: ClassVar[int] = SPARSE_DIM + PLACES

    def predict_rotations(self, encoded: Tensor) -> Tensor:
        local = center_on_head(encoded)
        moved = select_places(local) - select_places(local[:, :1])
        slow, fast = self.make_views(torch.cat([local, moved], -1))
        return self.encode(self.embedding(slow) + self.embedding(fast))

    @staticmethod
    def make_views(window: Tensor) -> tuple[Tensor, Tensor]:
        """Return the slow and the fast view of a window (..., T, n): half of its frames each."""
        slow = window[..., ::2, :]
        return slow, window[..., -slow.shape[-2] :, :]
