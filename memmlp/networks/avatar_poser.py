"""AvatarPoser (Jiang et al., ECCV 2022) and EgoPoser (Jiang et al., ECCV 2024).

A transformer encoder computes a feature of the newest frame, and heads predict the pose from it. EgoPoser
sees a fast and a slow view of a longer window. Three parts are left out: AvatarPoser's inverse kinematics of
the arms, EgoPoser's mask for invisible hands, and its head for the body's shape. All bodies here have the
mean shape.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.settings import at_least, fraction, setting, tuned
from memmlp.motion.body import N_JOINTS, SPARSE_DIM, SPARSE_POSITION, TRACKED
from memmlp.motion.network_coordinates import HeadRelative
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.motion_model import NewestFrameModel, StreamingGraph
from memmlp.networks.settings import NetworkSettings, Release, name_encoder
from memmlp.networks.streaming import StemGraph
from memmlp.networks.transformer import EncoderLayer, encode_newest_frame, initialize_weights, make_encoder

ROOT = 6  # components of the root's orientation, the first of the rotations


def make_head(width: int, size: int) -> nn.Module:
    """Make two linear layers with a ReLU between them, from `width` to `size`."""
    return nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, size))


class AvatarPoserGraph(StemGraph):
    """AvatarPoser's streaming graph, which carries each frame's embedding, first query, key and value."""

    float32_modules: tuple[str, ...] = ("model.embedding", "model.orientation", "model.rotation")
    model: AvatarPoser
    layers: list[EncoderLayer]

    def build(self, model: Any) -> None:
        self.model, self.layers = model, cast(list[EncoderLayer], list(model.layers))
        self.width = 4 * model.embedding.out_features

    def embed_frame(self, encoded: Tensor) -> Tensor:
        embedded, attention = self.model.embedding(encoded), self.layers[0].attention
        parts = attention.query(embedded), attention.key(embedded), attention.value(embedded)
        return torch.cat([embedded, *parts], -1)

    def predict_rotation(self, window: Tensor, encoded: Tensor) -> Tensor:
        *earlier, last = self.layers
        h, query, key, value = window.chunk(4, -1)
        for layer, following in zip(earlier, self.layers[1:], strict=True):
            h = layer.finish(h, layer.attention.attend(query[None], key[None], value[None])[0])
            attention = following.attention
            query, key, value = attention.query(h), attention.key(h), attention.value(h)
        attended = last.attention.attend(query[-1:][None], key[None], value[None])[0]
        return self.read(last.finish(h[-1:], attended), encoded)

    def read(self, newest: Tensor, encoded: Tensor) -> Tensor:
        """Map the newest frame's feature (1, d) and inputs (1, 54) to its rotations (1, 132)."""
        return self.model.read(newest)


@component("model", "avatar_poser", version=2, builds="AvatarPoser")
@dataclass
class AvatarPoserSettings(NetworkSettings):
    """AvatarPoser (Jiang et al. 2022): a transformer encoder that predicts the newest frame's rotations.

    Loss, features and initial weights (Kaiming normal, gain 0.2; biases 0) follow its released code. The
    training settings differ: AdamW with the profile's schedule, instead of Adam at 1e-4, halved every 60 K
    steps.
    """

    frames: int = setting(at_least(2), tiny=10, small=40, paper=40)  # T, the number of frames in a window
    width: int = setting(at_least(1), tiny=16, small=64, paper=256)  # d, the width of the hidden state
    depth: int = setting(at_least(1), 3)  # number of encoder layers
    heads: int = setting(at_least(1), 8)  # number of attention heads
    # the hidden width of the encoder's feed-forward layers
    feedforward: int = setting(at_least(1), tiny=64, small=512, paper=2048)
    dropout: float = setting(fraction(), 0.1)  # dropout in the encoder during training

    learns_newest_frame: ClassVar[bool] = True
    defaults: ClassVar = {"loss": "avatar_poser"}
    recipe: ClassVar = tuned(4.0e-3)
    release: ClassVar = Release(
        source="eth-siplab/AvatarPoser 0f97cb2",
        names={
            "embedding.*": "linear_embedding.*",
            **name_encoder("layers.*", "transformer_encoder.layers.*"),
            "orientation.*.*": "stabilizer.*.*",
            "rotation.*.*": "joint_rotation_decoder.*.*",
        },
        sizes={
            "model.width": ("linear_embedding.weight", 0),
            "model.depth": "transformer_encoder.layers.*.linear1.weight",
            "model.feedforward": ("transformer_encoder.layers.0.linear1.weight", 0),
        },
        unused=("body_model.**",),
    )


class AvatarPoser(NewestFrameModel):
    """AvatarPoser: an embedding, an encoder, and heads for the newest frame's orientation and rotations.

    It has 4,124,804 parameters at the paper's sizes (T = 40, d = 256, 8 heads, 3 layers, feed-forward 2048),
    4.12 M in Table 16. Post-norm, ReLU, dropout 0.1 and the missing positional encoding are our readings. The
    paper does not mention them, and its parameter count excludes learned positions.

    Attributes:
        inputs: number of embedded features per frame.
        rotated_joints: number of joints with predicted rotations besides the root.
    """

    graph: ClassVar[type[StreamingGraph] | None] = AvatarPoserGraph
    inputs: ClassVar[int] = SPARSE_DIM
    rotated_joints: ClassVar[int] = N_JOINTS - 1

    def __init__(self, normalizer: Normalizer, settings: AvatarPoserSettings):
        super().__init__(normalizer, settings.frames)
        self.embedding = nn.Linear(self.inputs, settings.width)
        self.layers = make_encoder(settings, settings.depth)
        self.orientation = make_head(settings.width, ROOT)
        self.rotation = make_head(settings.width, 6 * self.rotated_joints)
        initialize_weights(self)

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


PLACES = 2 * len(TRACKED)  # components of the trackers' places on the floor


def center_on_head(sparse: Tensor) -> Tensor:
    """Return inputs (..., 54) with floor positions relative to the head of the same frame."""
    space = HeadRelative()
    return space.convert_inputs_to_local(sparse, space.find_origin(sparse))


def select_floor_positions(sparse: Tensor) -> Tensor:
    """Return the trackers' floor positions (..., 6) from inputs (..., 54)."""
    return sparse[..., SPARSE_POSITION].unflatten(-1, (len(TRACKED), 3))[..., :2].flatten(-2)


class EgoPoserGraph(StemGraph):
    """EgoPoser's streaming graph, which carries each frame's embedding and floor positions.

    The slow view contains other frames at every step, so only the embedding can be carried. The movement
    since the window's first frame enters linearly, so the first frame's contribution is subtracted from the
    sum.
    """

    float32_modules = ("model.embedding", "model.orientation", "model.rotation")
    model: EgoPoser

    def build(self, model: Any) -> None:
        self.model, self.layers = model, cast(list[EncoderLayer], list(model.layers))
        self.width = model.embedding.out_features + PLACES

    def embed_frame(self, encoded: Tensor) -> Tensor:
        local = center_on_head(encoded)
        place = select_floor_positions(local)
        return torch.cat([self.model.embedding(torch.cat([local, place], -1)), place], -1)

    def predict_rotation(self, window: Tensor, encoded: Tensor) -> Tensor:
        embedded, places = window.split([self.width - PLACES, PLACES], -1)
        slow, fast = self.model.make_views(embedded)
        first = F.linear(places[:1], self.model.embedding.weight[:, SPARSE_DIM:])
        return self.model.read(encode_newest_frame(self.layers, slow + fast - 2 * first))


@component("model", "ego_poser", version=2, builds="EgoPoser")
@dataclass
class EgoPoserSettings(AvatarPoserSettings):
    """EgoPoser (Jiang et al. 2024): AvatarPoser's encoder over a fast and a slow view of a longer window.

    Loss and features follow its released code. The training settings are the same as for AvatarPoser.
    """

    # T, the number of frames in a window; the encoder sees half as many
    frames: int = setting(at_least(2), tiny=20, small=80, paper=80)

    defaults: ClassVar = {"loss": "ego_poser"}
    release: ClassVar = replace(
        AvatarPoserSettings.release,
        source="eth-siplab/EgoPoser 1acf2fd",
        names=AvatarPoserSettings.release.names | {"orientation.*.*": "global_orientation_decoder.*.*"},
        unused=("linear_embedding_fast.*", "shape_decoder.**"),
    )

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        yield from super().problems(config)
        normalizer = config["normalizer"]
        if normalizer["z_scores"] and normalizer["coordinates"] == "world":
            yield (
                "normalizer.z_scores=true: must be false with normalizer.coordinates=world, since "
                "model=ego_poser subtracts the head position"
            )


class EgoPoser(AvatarPoser):
    """EgoPoser: AvatarPoser's encoder over the sum of two views, its newer half and every second frame.

    It has 4,126,340 parameters at the paper's sizes (T = 80, otherwise AvatarPoser's); the released code has
    an unused layer of 7,808 parameters. Positions are relative to the floor point below the head of the same
    frame. Their movement since the window's first frame is appended to each frame's inputs; for the head it
    is 0.
    """

    graph = EgoPoserGraph
    inputs: ClassVar[int] = SPARSE_DIM + PLACES

    def predict_rotations(self, encoded: Tensor) -> Tensor:
        local = center_on_head(encoded)
        moved = select_floor_positions(local) - select_floor_positions(local[:, :1])
        slow, fast = self.make_views(torch.cat([local, moved], -1))
        return self.encode(self.embedding(slow) + self.embedding(fast))

    @staticmethod
    def make_views(window: Tensor) -> tuple[Tensor, Tensor]:
        """Return the slow and the fast view of a window (..., T, n), each with half of the frames."""
        slow = window[..., ::2, :]
        return slow, window[..., -slow.shape[-2] :, :]
