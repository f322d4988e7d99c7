"""AvatarJLM (Zheng et al., ICCV 2023): attention over joint-level tokens, across joints and across time."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.settings import at_least, fraction, setting, tuned
from memmlp.motion.body import HEAD, N_JOINTS, POSITION, ROTATION, SPARSE_DIM, TRACKED
from memmlp.motion.geometry import (
    complete_columns,
    convert_almost_rotations,
    forward_kinematics,
    matrix_to_sixd,
)
from memmlp.motion.normalizer import Normalizer, use_float32
from memmlp.networks.layers import replace_joints, split_by_feature
from memmlp.networks.motion_model import State, TrainingOutputs, WindowModel
from memmlp.networks.settings import NetworkSettings, Release, name_encoder
from memmlp.networks.streaming import StemGraph
from memmlp.networks.transformer import EncoderLayer, initialize_weights, make_encoder

JOINT_DIM = 18  # features of a joint: rotation, angular velocity, position, velocity
UNTRACKED_FEATURE = 0.01  # stands in all features of joints without a tracker
TOKENS = 2 * N_JOINTS + 1  # positions, rotations, and the inputs as a whole
MAX_EMBEDDED_FRAMES = 200  # frames that have a place of their own, as published
GROUPS = 8  # of the regressor's normalisation


def group_by_tracker(encoded: Tensor) -> Tensor:
    """Return inputs (..., 54) grouped by tracker (..., 3, 18)."""
    return torch.cat(split_by_feature(encoded), -1)


def spread_over_joints(encoded: Tensor) -> Tensor:
    """Spread inputs (..., 54) over the joints (..., 22 x 18); joints without a tracker hold a constant."""
    trackers = group_by_tracker(encoded)
    unseen = torch.full_like(trackers[..., :1, :], UNTRACKED_FEATURE)
    seen = dict(zip(TRACKED, trackers.split(1, -2), strict=True))
    rows = [seen.get(joint, unseen) for joint in range(N_JOINTS)]
    return torch.cat(rows, -2).flatten(-2)


def apply_to_batch(layer: EncoderLayer, h: Tensor, seen: Tensor) -> Tensor:
    """Apply an encoder layer to `h` (N, n, d) with attention to `seen` (N, m, d), by matrix products."""
    attention, flat, all_seen = layer.attention, h.flatten(0, 1), seen.flatten(0, 1)
    query = attention.query(flat).view(h.shape)
    key, value = (part(all_seen).view(seen.shape) for part in (attention.key, attention.value))
    return layer.finish(flat, attention.attend(query, key, value).flatten(0, 1)).view(h.shape)


class AvatarJLMGraph(StemGraph):
    """AvatarJLM's streaming graph, which carries the tokens of each frame, without position embeddings.

    Position embeddings change at every step, and attention looks both ways in time, so all layers are
    recomputed. The last layer, over time, computes only the newest frame.
    """

    float32_modules = ("model.embedding", "model.coarse", "model.regressor")
    model: AvatarJLM
    layers: list[EncoderLayer]

    def build(self, model: Any) -> None:
        self.model, self.layers = model, cast(list[EncoderLayer], list(model.layers))
        self.width = model.joint_places.numel()

    def embed_frame(self, encoded: Tensor) -> Tensor:
        return self.model.make_tokens(encoded).flatten(1)

    def predict_rotation(self, window: Tensor, encoded: Tensor) -> Tensor:
        h = self.model.add_position_embeddings(window.unflatten(-1, (TOKENS, -1)))
        first = h[:, -1:]
        for index, layer in enumerate(self.layers[:-1]):
            turned = h if index % 2 == 0 else h.transpose(0, 1)
            attended = apply_to_batch(layer, turned, turned)
            h = self.model.restore_input_token(
                attended if index % 2 == 0 else attended.transpose(0, 1), first
            )
        by_token = h.transpose(0, 1)
        newest = apply_to_batch(self.layers[-1], by_token[:, -1:], by_token).transpose(0, 1)
        features = self.model.restore_input_token(newest, first[-1:]).flatten(1)
        return self.read(self.model.regressor(features), encoded)

    def read(self, outputs: Tensor, encoded: Tensor) -> Tensor:
        """Map the newest frame's outputs and inputs (1, 54) to its rotations (1, 132)."""
        return outputs


@component("model", "avatar_jlm", version=3, builds="AvatarJLM")
@dataclass
class AvatarJLMSettings(NetworkSettings):
    """AvatarJLM (Zheng et al. 2023): attention over the joints of a coarse pose, and over time.

    Loss and features follow its released code. The floor is each window's lowest true joint; the released
    code finds it by clustering. The training settings differ: AdamW with the profile's schedule, instead of
    Adam at 1e-4 with a drop to a tenth at 60 K steps.
    """

    frames: int = setting(at_least(2), tiny=11, small=41, paper=41)  # T, the number of frames in a window
    # d, the width of a token; the layers for the coarse pose have width 2 d
    width: int = setting(at_least(4), tiny=16, small=32, paper=512)
    # number of blocks; each has one encoder layer over tokens and one over frames
    depth: int = setting(at_least(1), tiny=1, small=1, paper=6)
    heads: int = setting(at_least(1), tiny=4, small=2, paper=8)  # number of attention heads
    # the hidden width of the encoders' feed-forward layers
    feedforward: int = setting(at_least(1), tiny=64, small=128, paper=2048)
    dropout: float = setting(fraction(), 0.1)  # dropout in the encoders during training
    coarse_weight: float = setting(at_least(0), 1.0)  # weight of the loss for the coarse pose's joints
    # true: this loss counts tracked joints as exact, as in the released code
    coarse_untracked: bool | None = setting(None, None)

    defaults: ClassVar = {"loss": "avatar_jlm"}
    recipe: ClassVar = tuned(8.0e-3)
    release: ClassVar = Release(
        source="zxz267/AvatarJLM 9d27b35",
        names={
            "embedding.*": "linear_embedding_static.*",
            "coarse.*.*": "joint_regressor.regressor.*.*",
            "position_token.*": "position_embedding.*",
            "rotation_token.*": "rotation_embedding.*",
            "input_token.*": "input_token_embedding.*",
            "joint_places": "motion_net.joint_position_embed",
            "time_places": "motion_net.temp_embed",
            **name_encoder("layers.*", "motion_net.transformer.layers.*"),
            "regressor.*.*": "motion_net.param_regressor.*.*",
        },
        sizes={
            "model.width": ("position_embedding.weight", 0),
            "model.depth": "motion_net.transformer.STB.*.layers.0.linear1.weight",
            "model.feedforward": ("motion_net.transformer.STB.0.layers.0.linear1.weight", 0),
        },
        unused=("body_model.**", "joint_regressor.body_model.**", "motion_net.body_model.**"),
    )

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        yield from super().problems(config)
        if config["model"]["width"] % 4:
            yield f"model.width={config['model']['width']}: must be a multiple of 4 with this model"


class AvatarJLM(WindowModel):
    """AvatarJLM: a coarse pose per frame, joint tokens, encoder layers, and a head on all tokens of a frame.

    It has 63,807,240 parameters at the paper's sizes (T = 41, d = 512, 6 blocks). It predicts all frames of a
    window; a live stream keeps the last one.

    Attributes:
        outputs: number of outputs per frame.
    """

    graph = AvatarJLMGraph
    outputs: ClassVar[int] = ROTATION.stop

    def __init__(self, normalizer: Normalizer, settings: AvatarJLMSettings):
        super().__init__(normalizer, settings.frames)
        self.coarse_weight, hidden = settings.coarse_weight, 2 * settings.width
        self.coarse_untracked = settings.coarse_untracked
        self.embedding = nn.Linear(N_JOINTS * JOINT_DIM, hidden)
        self.coarse = nn.Sequential(
            nn.Linear(hidden, hidden), nn.LeakyReLU(0.1), nn.Linear(hidden, ROTATION.stop)
        )
        self.position_token, self.rotation_token = nn.Linear(3, settings.width), nn.Linear(6, settings.width)
        self.input_token = nn.Linear(hidden, settings.width)
        self.joint_places = nn.Parameter(torch.empty(TOKENS, settings.width))
        self.time_places = nn.Parameter(
            torch.empty(max(MAX_EMBEDDED_FRAMES, settings.frames), 1, settings.width)
        )
        for places in (self.joint_places, self.time_places):
            nn.init.trunc_normal_(places, std=0.02)
        self.layers = make_encoder(settings, 2 * settings.depth)
        self.regressor = nn.Sequential(
            nn.Linear(TOKENS * settings.width, hidden),
            nn.GroupNorm(GROUPS, hidden),
            nn.LeakyReLU(0.1),
            nn.Linear(hidden, self.outputs),
        )
        initialize_weights(self)

    @classmethod
    def adapt_published(cls, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Number the layers in order: the released code has a list for joints and a list for frames."""

        def rename(name: str) -> str:
            pattern = r"(motion_net\.transformer\.)([ST])T(?:B|Eblocks)\.(\d+)\.layers\.0(\..*)"
            found = re.fullmatch(pattern, name)  # MANIKIN-L calls them STEblocks and TTEblocks
            return f"{found[1]}layers.{2 * int(found[3]) + (found[2] == 'T')}{found[4]}" if found else name

        return {rename(name): tensor for name, tensor in tensors.items()}

    @staticmethod
    def read_coarse_pose(sixd: Tensor) -> tuple[Tensor, Tensor]:
        """Return the coarse pose's local matrices (..., 22, 3, 3) for rotation tokens, and its rotations.

        Like the released code, it does not make the columns orthonormal for the tokens. Positions follow from
        the rotations that human_body_prior reads from them.
        """
        columns = complete_columns(sixd)
        return columns, convert_almost_rotations(columns)

    def place_coarse_joints(self, embedded: Tensor) -> tuple[Tensor, Tensor]:
        """Return the coarse pose for embeddings (..., 2 d), in the network's coordinates without z-scores.

        Returns:
            Joints (..., 22, 3), metres, relative to the head, and their global 6D rotations (..., 22, 6).
        """
        mean, std = (part[SPARSE_DIM:][ROTATION] for part in (self.normalizer.mean, self.normalizer.std))
        sixd = (self.coarse(embedded) * std + mean).unflatten(-1, (N_JOINTS, 6))
        with use_float32(sixd.device):
            matrices, rotations = self.read_coarse_pose(sixd)
            pelvis = torch.zeros_like(rotations[..., 0, :, 0])
            turned, positions = forward_kinematics(rotations, pelvis, self.normalizer.rest)
            if matrices is not rotations:
                turned, _ = forward_kinematics(matrices, pelvis, self.normalizer.rest)
        return positions - positions[..., HEAD : HEAD + 1, :], matrix_to_sixd(turned)

    def make_tokens(self, encoded: Tensor) -> Tensor:
        """Map inputs (..., 54) in network space to tokens (..., 45, d), without position embeddings."""
        embedded = self.embedding(spread_over_joints(encoded))
        positions, rotations = self.place_coarse_joints(embedded)
        seen = encoded * self.normalizer.std[:SPARSE_DIM] + self.normalizer.mean[:SPARSE_DIM]
        tracked_rotations, _, places, _ = split_by_feature(seen)
        positions = replace_joints(positions, TRACKED, places - places[..., :1, :])
        rotations = replace_joints(rotations, TRACKED, tracked_rotations)
        whole = self.input_token(embedded.detach())[..., None, :]
        return torch.cat([self.position_token(positions), self.rotation_token(rotations), whole], -2)

    def add_position_embeddings(self, tokens: Tensor) -> Tensor:
        """Add the position embeddings of joints and frames to the tokens (..., T, 45, d) of a window."""
        return tokens + self.joint_places + self.time_places[: tokens.shape[-3]]

    @staticmethod
    def restore_input_token(h: Tensor, first: Tensor) -> Tensor:
        """Return tokens (..., 45, d) with the last token, the input token, replaced by `first` (..., 1, d).

        `first` is the input token before all blocks. No gradient flows through it.
        """
        return torch.cat([h[..., :-1, :], first.detach()], -2)

    def predict_rotations(self, encoded: Tensor) -> Tensor:
        return self.regress(encoded)

    def regress(self, encoded: Tensor) -> Tensor:
        """Map inputs (B, T, 54) in network space to the regressor's outputs (B, T, n)."""
        h = self.add_position_embeddings(self.make_tokens(encoded))
        first = h[..., -1:, :]
        for index, layer in enumerate(self.layers):
            if index % 2 == 0:
                h = layer(h.flatten(0, 1)).unflatten(0, encoded.shape[:2])
            else:
                h = layer(h.transpose(1, 2).flatten(0, 1)).unflatten(0, (-1, TOKENS)).transpose(1, 2)
            h = self.restore_input_token(h, first)
        return self.regressor(h.flatten(-2).flatten(0, 1)).unflatten(0, encoded.shape[:2])

    def compute_training_outputs(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Predict the motion, and add a loss of the coarse pose; see MotionModel."""
        return TrainingOutputs(*self.advance(sparse, state), self.compute_coarse_loss(true_frames))

    def compute_coarse_loss(self, true_frames: Tensor) -> dict[str, Tensor]:
        """Return the weighted mean absolute error of the coarse pose's joints, relative to the head.

        Args:
            true_frames: world frames [X | Theta] (B, T, 252).
        """
        sparse, motion = true_frames[..., :SPARSE_DIM], true_frames[..., SPARSE_DIM:]
        origin = self.normalizer.find_origin(sparse)
        encoded = self.normalizer.encode_sparse(sparse, origin)
        coarse_joints, _ = self.place_coarse_joints(self.embedding(spread_over_joints(encoded)))
        true_positions = self.normalizer.coordinates.convert_motion_to_local(motion, origin)[..., POSITION]
        joints = true_positions.unflatten(-1, (N_JOINTS, 3))
        joints = joints - joints[..., HEAD : HEAD + 1, :]
        if self.coarse_untracked:
            coarse_joints = replace_joints(coarse_joints, TRACKED, joints[..., list(TRACKED), :])
        error = coarse_joints - joints
        return {"coarse": self.coarse_weight * error.abs().mean()}
