"""HMD-Poser (Dai et al., CVPR 2024): recurrent layers over time, and a transformer over a frame's trackers.

This is the published network for three trackers. Its inputs for sensors on legs and pelvis are zero. All
bodies here have the mean shape, so the predicted shape does not affect joint positions.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.settings import at_least, fraction, setting, tuned
from memmlp.motion.body import ROTATION, TRACKED
from memmlp.motion.geometry import matrix_to_sixd, sixd_to_matrix
from memmlp.motion.normalizer import Normalizer, use_float32
from memmlp.networks.layers import split_by_feature
from memmlp.networks.motion_model import FrameGraph, State, TrainingOutputs, WindowlessModel
from memmlp.networks.settings import NetworkSettings, Release, name_encoder
from memmlp.networks.transformer import make_encoder

HANDS, OTHERS = 2, 3  # tokens of hands in the head's frame, and of the sensors that there are none of
TOKENS = len(TRACKED) + HANDS + OTHERS
SHAPE = 16  # components of a body's shape
RELEASED_ORDER = (0, 1, 2, 6, 7, 3, 4, 5)  # the place of each token in the released code

# On a GPU cuDNN copies an LSTM's weights into one piece: at each call, since they are computed at each call.
warnings.filterwarnings("ignore", message="RNN module weights are not part of single contiguous chunk")


def convert_hands_to_head_frame(rotation: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
    """Return the hands' rotations (..., 2, 3, 3) and positions (..., 2, 3) in the head's frame.

    Args:
        rotation: rotations of head and hands (..., 3, 3, 3).
        position: positions of head and hands (..., 3, 3).
    """
    back = rotation[..., :1, :, :].transpose(-1, -2)
    away = position[..., 1:, :] - position[..., :1, :]
    return back @ rotation[..., 1:, :, :], (back @ away[..., None])[..., 0]


def locate_hands(sparse: Tensor) -> list[Tensor]:
    """Return both hands' features in the head's frame, for world inputs (..., 54); see `split_by_feature`.

    The previous frame is reconstructed from the velocities in the inputs. The computation is always in
    float32, because velocities are small differences.
    """
    rotation, turn, position, velocity = split_by_feature(sparse)
    with use_float32(sparse.device):
        now = sixd_to_matrix(rotation)
        before = now @ sixd_to_matrix(turn).transpose(-1, -2)
        rotations, positions = convert_hands_to_head_frame(now, position)
        earlier, places = convert_hands_to_head_frame(before, position - velocity)
        turned = earlier.transpose(-1, -2) @ rotations
    return [matrix_to_sixd(rotations), matrix_to_sixd(turned), positions, positions - places]


class TokenEmbedding(nn.Module):
    """A token of concatenated parts, each from a linear layer and LeakyReLU.

    Args:
        inputs: number of features of each part.
        outputs: number of token features from each part.
    """

    def __init__(self, inputs: Sequence[int], outputs: Sequence[int]):
        super().__init__()
        self.parts = nn.ModuleList(nn.Linear(*sizes) for sizes in zip(inputs, outputs, strict=True))

    def forward(self, *parts: Tensor) -> Tensor:
        """Map the parts (..., n) to the token (..., d)."""
        features = [layer(part) for layer, part in zip(self.parts, parts, strict=True)]
        return F.leaky_relu(torch.cat(features, -1))


class NormedLSTM(nn.Module):
    """An LSTM with normalised weights: a direction and a learned gain for each row (Salimans & Kingma 2016).

    Args:
        width: d, the width of inputs and outputs.
    """

    def __init__(self, width: int):
        super().__init__()
        plain = nn.LSTM(width, width)
        self.directions = nn.ParameterList([plain.weight_ih_l0, plain.weight_hh_l0])
        for direction in self.directions:
            nn.init.orthogonal_(direction)
        self.gains = nn.ParameterList([d.detach().norm(dim=1, keepdim=True) for d in self.directions])
        self.biases = nn.ParameterList([plain.bias_ih_l0, plain.bias_hh_l0])

    def forward(self, x: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Run over inputs (B, n, d) from states (B, d); return outputs (B, n, d) and new states."""
        pairs = zip(self.directions, self.gains, strict=True)
        weights = [F.normalize(direction, dim=1) * gain for direction, gain in pairs]
        states = [state.contiguous()[None] for state in (hidden, cell)]
        with use_float32(x.device):  # not every CPU has an LSTM in bfloat16
            outputs, *after = torch.lstm(
                x.float() if x.dtype == torch.bfloat16 else x,
                states, [*weights, *self.biases], True, 1, 0.0, self.training, False, True,
            )  # fmt: skip
        return outputs, after[0][0], after[1][0]


class TimeAndTokenBlock(nn.Module):
    """An LSTM over time for each token, then encoder layers over the tokens of each frame.

    Args:
        settings: the network's settings.
    """

    def __init__(self, settings: HMDPoserSettings):
        super().__init__()
        self.over_time = nn.ModuleList(NormedLSTM(settings.width) for _ in range(TOKENS))
        self.layers = make_encoder(settings, settings.encoder_layers)

    def forward(self, tokens: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map tokens (B, n, 8, d) and states (B, 8, d) to new tokens, and to states after the last frame."""
        each = [part.unbind(axis) for part, axis in ((tokens, 2), (hidden, 1), (cell, 1))]
        results = [lstm(*of) for lstm, *of in zip(self.over_time, *each, strict=True)]
        outputs, hidden, cell = (
            torch.stack(of, axis) for of, axis in zip(zip(*results, strict=True), (2, 1, 1), strict=True)
        )
        h = outputs.flatten(0, 1).squeeze(0)  # without a batch axis, a live frame is exported to plain layers
        for layer in self.layers:
            h = layer(h)
        return h.view(tokens.shape), hidden, cell


class HMDPoserGraph(FrameGraph):
    """HMD-Poser's streaming graph."""

    float32_modules = ("model.trackers", "model.hands", "model.others", "model.pose")
    model: HMDPoser

    def step(self, sparse: Tensor, state: State, is_first_step: Tensor) -> tuple[Tensor, State]:
        features, kept = self.model.compute_features(sparse[None], state)
        return self.normalizer.decode_rotations(self.model.pose(features[0]), sparse), kept


@component("model", "hmd_poser", builds="HMDPoser")
@dataclass
class HMDPoserSettings(NetworkSettings):
    """HMD-Poser (Dai et al. 2024) with three trackers: LSTMs, and a transformer over a frame's tokens.

    It is a stream without a window. Loss and features follow its released code, on the mean body. The
    training settings differ: AdamW with the profile's schedule, instead of Adam at 1e-3 with a warm-up and a
    drop after 300 of 400 epochs.
    """

    # T, the number of frames in a training window, from zero states; live there is no window
    frames: int = setting(at_least(2), tiny=10, small=40, paper=40)
    width: int = setting(at_least(4), tiny=16, small=48, paper=256)  # d, the width of a token
    depth: int = setting(at_least(1), 2)  # number of blocks: one LSTM per token, then a transformer
    encoder_layers: int = setting(at_least(1), tiny=1, small=1, paper=3)  # number of encoder layers per block
    heads: int = setting(at_least(1), 8)  # number of attention heads
    # the hidden width of the encoders' feed-forward layers
    feedforward: int = setting(at_least(1), tiny=64, small=256, paper=2048)
    dropout: float = setting(fraction(), 0.1)  # dropout in the encoders during training
    # weight of the loss that keeps the predicted body shape constant within a window; 0: the network does not
    # predict the shape
    shape_weight: float = setting(at_least(0), 0.1)

    defaults: ClassVar = {"loss": "hmd_poser"}
    recipe: ClassVar = tuned(8.0e-3)
    release: ClassVar = Release(
        source="Pico-AI-Team/HMD-Poser 7c3470d",
        names={
            "trackers.0.parts.*.*": "backbone.head_linear_embeddings.*.0.*",
            "trackers.1.parts.*.*": "backbone.lhand_linear_embeddings.*.0.*",
            "trackers.2.parts.*.*": "backbone.rhand_linear_embeddings.*.0.*",
            "hands.0.parts.*.*": "backbone.lhand_inhead_linear_embeddings.*.0.*",
            "hands.1.parts.*.*": "backbone.rhand_inhead_linear_embeddings.*.0.*",
            "others.0.parts.*.*": "backbone.lfoot_linear_embeddings.*.0.*",
            "others.1.parts.*.*": "backbone.rfoot_linear_embeddings.*.0.*",
            "others.2.parts.*.*": "backbone.pelvis_linear_embeddings.*.0.*",
            "norm.*": "backbone.norm.*",
            "blocks.*.over_time.*.directions.0": "backbone.time_encoder.*.*.weight_ih_l0_v",
            "blocks.*.over_time.*.directions.1": "backbone.time_encoder.*.*.weight_hh_l0_v",
            "blocks.*.over_time.*.gains.0": "backbone.time_encoder.*.*.weight_ih_l0_g",
            "blocks.*.over_time.*.gains.1": "backbone.time_encoder.*.*.weight_hh_l0_g",
            "blocks.*.over_time.*.biases.0": "backbone.time_encoder.*.*.bias_ih_l0",
            "blocks.*.over_time.*.biases.1": "backbone.time_encoder.*.*.bias_hh_l0",
            **name_encoder("blocks.*.layers.*", "backbone.spatial_encoder.*.layers.*"),
            "pose.*.*": "pose_est.*.*",
            "shape.*.*": "shape_est.*.*",
        },
        sizes={
            "model.width": ("backbone.norm.weight", 0),
            "model.depth": "backbone.time_encoder.*.0.bias_ih_l0",
            "model.encoder_layers": "backbone.spatial_encoder.0.layers.*.linear1.weight",
            "model.feedforward": ("backbone.spatial_encoder.0.layers.0.linear1.weight", 0),
        },
    )


class HMDPoser(WindowlessModel):
    """HMD-Poser: tracker tokens, blocks of LSTMs and encoder layers, and a head on all tokens of a frame.

    It has 17,444,484 parameters at the paper's sizes, including 528,656 for the shape head. It carries two
    states of d numbers for each LSTM, in total 8,192 numbers. Evaluation runs over whole clips, training over
    windows of T frames, both from zero states.
    """

    graph = HMDPoserGraph

    def __init__(self, normalizer: Normalizer, settings: HMDPoserSettings):
        super().__init__(normalizer, settings.frames)
        self.width, self.depth, self.shape_weight = settings.width, settings.depth, settings.shape_weight
        bounds = [settings.width * part // 4 for part in range(5)]  # four parts, as equal as possible
        tracked = (6, 6, 3, 3), [stop - start for start, stop in pairwise(bounds)]
        turns = 15 * settings.width // 32
        self.trackers = nn.ModuleList(TokenEmbedding(*tracked) for _ in TRACKED)
        self.hands = nn.ModuleList(TokenEmbedding(*tracked) for _ in range(HANDS))
        unseen = (6, 6, 3), (turns, turns, settings.width - 2 * turns)
        self.others = nn.ModuleList(TokenEmbedding(*unseen) for _ in range(OTHERS))
        self.norm = nn.LayerNorm(settings.width, eps=1e-6)
        self.blocks = nn.ModuleList(TimeAndTokenBlock(settings) for _ in range(settings.depth))
        self.pose = self._make_head(ROTATION.stop)
        self.shape = self._make_head(SHAPE) if settings.shape_weight else None

    def _make_head(self, size: int) -> nn.Module:
        return nn.Sequential(
            nn.Linear(TOKENS * self.width, self.width), nn.LeakyReLU(), nn.Linear(self.width, size)
        )

    @classmethod
    def adapt_published(cls, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Reorder the tokens: the released code has those of absent sensors before the relative hands."""

        def reorder(name: str) -> str:
            found = re.fullmatch(r"(backbone\.time_encoder\.\d+\.)([0-7])(\..*)", name)
            return f"{found[1]}{RELEASED_ORDER.index(int(found[2]))}{found[3]}" if found else name

        moved = {reorder(name): tensor for name, tensor in tensors.items()}
        for name in ("pose_est.0.weight", "shape_est.0.weight"):
            if name in moved and moved[name].dim() == 2 and moved[name].shape[1] % TOKENS == 0:
                columns = moved[name].unflatten(1, (TOKENS, -1))
                moved[name] = columns[:, list(RELEASED_ORDER)].flatten(1)
        return moved

    def initial_state(self, batch: int = 1) -> State:
        """Return the initial state: zeros (B, 8 x depth, d)."""
        state = torch.zeros(batch, TOKENS * self.depth, self.width).to(self.normalizer.mean)
        return {"hidden": state, "cell": state.clone()}

    def make_tokens(self, sparse: Tensor) -> Tensor:
        """Map world inputs (B, n, 54) to the tokens (B, n, 8, d)."""
        encoded = self.normalizer.encode_sparse(sparse, self.normalizer.find_origin(sparse))
        nothing = [encoded.new_zeros(*encoded.shape[:-1], OTHERS, size) for size in (6, 6, 3)]
        tokens = []
        for layers, parts in (
            (self.trackers, split_by_feature(encoded)),
            (self.hands, locate_hands(sparse)),
            (self.others, nothing),
        ):
            each = zip(layers, *(part.unbind(-2) for part in parts), strict=True)
            tokens += [layer(*token_parts) for layer, *token_parts in each]
        return self.norm(torch.stack(tokens, -2))

    def compute_features(self, sparse: Tensor, state: State) -> tuple[Tensor, State]:
        """Map world inputs (B, n, 54) and the state to features (B, n, 8 d) and the new state."""
        tokens = self.make_tokens(sparse)
        states = (state[name].split(TOKENS, 1) for name in ("hidden", "cell"))
        carried = []
        for block, *of in zip(self.blocks, *states, strict=True):
            tokens, *after = block(tokens, *of)
            carried.append(after)
        hidden, cell = (torch.cat(of, 1) for of in zip(*carried, strict=True))
        return tokens.flatten(-2), {"hidden": hidden, "cell": cell}

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        features, kept = self.compute_features(sparse, state)
        count = sparse.shape[1] if newest is None else newest
        return self.normalizer.decode_rotations(self.pose(features[:, -count:]), sparse[:, -count:]), kept

    def compute_training_outputs(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Predict the motion, and add the loss of the predicted shape; see MotionModel."""
        features, kept = self.compute_features(sparse, state)
        losses = {}
        if self.shape is not None:  # how much the predicted shapes vary within a window
            shapes = self.shape(features).to(self.normalizer.mean)  # their differences are small
            variation = (shapes - shapes.mean(1, keepdim=True)).abs().mean()
            losses["shape"] = self.shape_weight * variation
        return TrainingOutputs(self.normalizer.decode_rotations(self.pose(features), sparse), kept, losses)
