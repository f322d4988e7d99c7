"""AvatarPoser (Jiang et al., ECCV 2022): a transformer encoder whose feature of the newest frame is read.

Its final step, inverse kinematics of the arms, is not part of the network and is left out here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.settings import at_least, fraction, setting
from memmlp.motion.body import N_JOINTS, SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.motion_model import NewestFrameModel, State, StreamingGraph, slide_window
from memmlp.networks.settings import NetworkSettings
from memmlp.networks.transformer import EncoderLayer, draw_weights

ROOT = 6  # components of the root's orientation, the first of the rotations


def head(width: int, size: int) -> nn.Module:
    """Make two linear layers with a ReLU between them, from `width` to `size`."""
    return nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, size))


class AvatarPoserGraph(StreamingGraph):
    """AvatarPoser's streaming graph."""

    float32_modules: tuple[str, ...] = ("model.embedding", "model.orientation", "model.rotation")
    model: AvatarPoser
    layers: list[EncoderLayer]

    def build(self, model: Any) -> None:
        self.model, self.layers = model, cast(list[EncoderLayer], list(model.layers))

    def windows(self) -> State:
        """Return zeros (T, 4 d): each frame's embedding and first query, key and value, side by side."""
        return {"first": torch.zeros(self.frames, 4 * self.model.embedding.out_features)}

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        encoded = self.normalizer.encode_sparse(sparse, self.normalizer.origin(sparse))
        embedded = self.model.embedding(encoded)
        *earlier, last = self.layers
        attention = self.layers[0].attention
        entering = torch.cat(
            [embedded, attention.query(embedded), attention.key(embedded), attention.value(embedded)], -1
        )
        first = slide_window(state["first"], entering, entering, fresh)
        h, query, key, value = first.chunk(4, -1)
        for layer, following in zip(earlier, self.layers[1:], strict=True):
            h = layer.finish(h, layer.attention.attend(query[None], key[None], value[None])[0])
            attention = following.attention
            query, key, value = attention.query(h), attention.key(h), attention.value(h)
        attended = last.attention.attend(query[-1:][None], key[None], value[None])[0]
        features = last.finish(h[-1:], attended)
        return self.normalizer.posed(self.predict_rotation(features, encoded), sparse), {"first": first}

    def predict_rotation(self, newest: Tensor, encoded: Tensor) -> Tensor:
        """Map the newest frame's feature (1, d) and inputs (1, 54) to its rotations (1, 132)."""
        return self.model.read(newest)


@component("model", "avatar_poser", version=2, builds="AvatarPoser")
@dataclass
class AvatarPoserSettings(NetworkSettings):
    """AvatarPoser (Jiang et al. 2022): a transformer encoder that predicts the newest frame's rotations.

    Loss, features and initial weights (Kaiming's normal ones, gain 0.2; biases 0) are those of its released
    code. Training is this project's: AdamW with its schedule, in place of Adam at 1e-4, halved every 60 K
    steps.
    """

    frames: int = setting(at_least(2), tiny=10, small=40, paper=40)  # T, the frames of a window
    width: int = setting(at_least(1), tiny=16, small=64, paper=256)  # d, the width of the hidden state
    depth: int = setting(at_least(1), 3)  # encoder layers
    heads: int = setting(at_least(1), 8)  # heads of attention
    # the hidden width of the encoder's feed-forward layers
    feedforward: int = setting(at_least(1), tiny=64, small=512, paper=2048)
    dropout: float = setting(fraction(), 0.1)  # in the encoder, while training

    learns_newest_frame: ClassVar[bool] = True
    defaults: ClassVar = {"loss": "avatar_poser"}


class AvatarPoser(NewestFrameModel):
    """An embedding, an encoder, and two heads on the newest frame, for the root's orientation and the rest.

    It has 4,124,804 parameters at the paper's sizes (T = 40, d = 256, 8 heads, 3 layers, feed-forward 2048),
    4.12 M in Table 16. Post-norm, ReLU, dropout 0.1 and the lack of a positional encoding are our readings:
    the paper names none of them, and its parameter count leaves no room for learned positions.

    Attributes:
        inputs: how many features of a frame are embedded.
        rotated: how many joints' rotations are predicted besides the root's.
    """

    graph: ClassVar[type[StreamingGraph] | None] = AvatarPoserGraph
    inputs: ClassVar[int] = SPARSE_DIM
    rotated: ClassVar[int] = N_JOINTS - 1

    def __init__(self, normalizer: Normalizer, settings: AvatarPoserSettings):
        super().__init__(normalizer, settings.frames)
        self.embedding = nn.Linear(self.inputs, settings.width)
        self.layers = nn.ModuleList(
            EncoderLayer(settings.width, settings.heads, settings.feedforward, settings.dropout)
            for _ in range(settings.depth)
        )
        self.orientation = head(settings.width, ROOT)
        self.rotation = head(settings.width, 6 * self.rotated)
        draw_weights(self)

    def predict_rotations(self, encoded: Tensor) -> Tensor:
        return self.encode(self.embedding(encoded))

    def encode(self, h: Tensor) -> Tensor:
        """Map the embeddings of windows (B, T, d) to the rotations (B, 132) of their last frames."""
        for layer in self.layers:
            h = layer(h)
        return self.read(h[:, -1])

    def read(self, newest: Tensor) -> Tensor:
        """Map the newest frame's feature (..., d) to rotations (..., 132)."""
        return torch.cat([self.orientation(newest), self.rotation(newest)], -1)
