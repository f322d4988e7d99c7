"""RPM (Rolling Prediction Model, CVPR 2025): each step predicts the next frames again.

A new prediction may change near frames less than far frames. The nearest frame is shown.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common import distributed
from memmlp.common.components import component
from memmlp.common.settings import at_least, fraction, setting, tuned
from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.motion_model import FrameGraph, State, TrainingOutputs, WindowlessModel
from memmlp.networks.settings import NetworkSettings, Release, name_encoder
from memmlp.networks.transformer import Attention, make_encoder

FRESH_FRACTION = 0.25  # of the training windows begin as a live stream does, without a past


class RPMGraph(FrameGraph):
    """RPM's streaming graph."""

    float32_modules = ("model.motion", "model.sparse", "model.head")
    model: RPM


@component("model", "rpm", builds="RPM")
@dataclass
class RPMSettings(NetworkSettings):
    """RPM (CVPR 2025): a stream that predicts the next frames at every step, and refines them in later steps.

    Loss and features follow its released code, but inputs are z-scores, and hands are always visible.
    Training uses AdamW with the profile's schedule.
    """

    # T, the number of frames in a training window: the context, up to T - context - horizon freely predicted
    # frames, and the horizon
    frames: int = setting(at_least(2), tiny=24, small=80, paper=80)
    width: int = setting(at_least(1), tiny=16, small=96, paper=512)  # d, the width of the hidden state
    depth: int = setting(at_least(1), tiny=2, small=2, paper=4)  # number of encoder layers
    heads: int = setting(at_least(1), 4)  # number of attention heads
    # the hidden width of the encoder's feed-forward layers
    feedforward: int = setting(at_least(1), tiny=32, small=192, paper=1024)
    dropout: float = setting(fraction(), 0.1)  # dropout in the encoder during training
    # number of past frames of its predicted motion that the network sees; it sees one more frame of inputs
    context: int = setting(at_least(1), 10)
    # true: use dropout when predicting the past motion in training; the released code does not
    own_dropout: bool = setting(default=False)
    # number of frames to predict; RPM's paper uses 10 (reactive) or 20 (smooth)
    horizon: int = setting(at_least(1), 10)
    # true: the first prediction of a frame is its tanh, as in the released code; null or false: unchanged
    bounded_first: bool | None = setting(default=None)
    # true: training windows begin with true predictions, as in the released code; null or false: without
    # predictions, and a quarter of them without a past
    true_start: bool | None = setting(default=None)

    defaults: ClassVar = {"loss": "rpm"}
    recipe: ClassVar = {"normalizer.z_scores": True, **tuned(8.0e-3)}
    release: ClassVar = Release(
        source="facebookresearch/motion_rolling_prediction 64fe8f1",
        names={
            "motion.*": "input_process.poseEmbedding.*",
            "sparse.*": "sparse_process.poseEmbedding.*",
            "attention.query.*": "xatt.in_proj_*[0/3]",
            "attention.key.*": "xatt.in_proj_*[1/3]",
            "attention.value.*": "xatt.in_proj_*[2/3]",
            "attention.out.*": "xatt.out_proj.*",
            "norm.*": "xatt_norm.*",
            **name_encoder("layers.*", "seqTransEncoder.layers.*"),
            "head.*": "output_process.poseFinal.*",
        },
        sizes={
            "model.width": ("xatt_norm.weight", 0),
            "model.depth": "seqTransEncoder.layers.*.linear1.weight",
            "model.feedforward": ("seqTransEncoder.layers.0.linear1.weight", 0),
        },
        unused=("xatt_ff.*", "sequence_pos_encoder.pe"),
        config={"normalizer.raw_inputs": True, "model.bounded_first": True},
    )

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        yield from super().problems(config)
        model = config["model"]
        least = model["context"] + model["horizon"]
        if model["frames"] < least:
            yield f"model.frames={model['frames']}: must be at least model.context + model.horizon = {least}"


class RPM(WindowlessModel):
    """RPM: cross-attention from past and future motion to the newest inputs, then encoder layers.

    It has 9,626,756 parameters at the paper's sizes; the released code has an additional unused layer of
    262,656 (9,889,412). Our readings: the first prediction of a frame is used unchanged. A live stream begins
    with zeros as past motion, like a quarter of the training windows. Its first frame's inputs replace
    earlier inputs.
    """

    graph = RPMGraph
    places: Tensor
    freedom: Tensor

    def __init__(self, normalizer: Normalizer, settings: RPMSettings):
        super().__init__(normalizer, settings.frames)
        self.context, self.horizon = settings.context, settings.horizon
        self.own_dropout, self.bounded_first = settings.own_dropout, bool(settings.bounded_first)
        self.true_start = bool(settings.true_start)
        self.motion = nn.Linear(ROTATION.stop, settings.width)
        self.sparse = nn.Linear(SPARSE_DIM, settings.width)
        self.attention = Attention(settings.width, settings.heads)
        self.norm = nn.LayerNorm(settings.width)
        self.layers = make_encoder(settings, settings.depth, F.gelu)
        self.head = nn.Linear(settings.width, ROTATION.stop)
        # Sines and cosines as position embeddings (context + W, d) (Vaswani et al. 2017, Sec. 3.5).
        rates = torch.exp(-math.log(10_000) * torch.arange(0, settings.width, 2) / settings.width)
        angles = torch.arange(settings.context + settings.horizon)[:, None] * rates
        places = torch.stack([angles.sin(), angles.cos()], -1).flatten(-2)[:, : settings.width]
        self.register_buffer("places", places, persistent=False)
        # How far each of the predicted frames (W, 1) may change at a step, from almost 0 to 1.
        distance = torch.arange(1, settings.horizon + 1, dtype=torch.float64) / settings.horizon
        freedom = (1 - (distance * math.pi / 2).cos())[:, None].float()
        self.register_buffer("freedom", freedom, persistent=False)

    def initial_state(self, batch: int = 1) -> State:
        """Return the initial state, zeros.

        `started` and `predicted` are 1 as soon as `sparse` and `prediction` hold frames.
        """
        sizes = {
            "sparse": (self.context, SPARSE_DIM),
            "motion": (self.context, ROTATION.stop),
            "prediction": (self.horizon, ROTATION.stop),
            "started": (1,),
            "predicted": (1,),
        }
        return {name: torch.zeros(batch, *size).to(self.normalizer.mean) for name, size in sizes.items()}

    def predict(self, motion: Tensor, encoded: Tensor) -> Tensor:
        """Predict W frames (B, W, 132) from past motion (B, context, 132) and inputs (B, context + 1, 54)."""
        future = motion.new_zeros(len(motion), self.horizon, ROTATION.stop)
        queries = self.motion(torch.cat([motion, future], 1)) + self.places
        seen = self.sparse(encoded) + self.places[: encoded.shape[1]]
        h = self.norm(queries + self.attention(queries, seen))
        h = h.squeeze(0)  # without a batch axis, a live step has plain layers
        for layer in self.layers:
            h = layer(h)
        return self.head(h[..., -self.horizon :, :]).view(future.shape)

    def step_frame(self, encoded: Tensor, state: State) -> tuple[Tensor, State]:
        """Process one frame.

        Args:
            encoded: inputs (B, 1, 54) in network space.
            state: the state before that frame.

        Returns:
            The prediction (B, W, 132) from that frame on, in network space, and the new state.
        """
        previous_inputs = torch.where(state["started"][..., None] > 0, state["sparse"], encoded)
        inputs = torch.cat([previous_inputs, encoded], 1)
        prediction = self.predict(state["motion"], inputs)
        newest = prediction[:, -1:] * (0.0 if self.bounded_first else 1.0)
        earlier = torch.cat([state["prediction"][:, 1:], newest], 1)
        earlier = torch.where(state["predicted"][..., None] > 0, earlier, prediction)
        prediction = earlier + self.freedom * (prediction - earlier).tanh()
        return prediction, {
            "sparse": inputs[:, 1:],
            "motion": torch.cat([state["motion"], prediction[:, :1]], 1)[:, 1:],
            "prediction": prediction,
            "started": torch.ones_like(state["started"]),
            "predicted": torch.ones_like(state["predicted"]),
        }

    def encode(self, sparse: Tensor) -> Tensor:
        """Map world inputs (..., 54) to network space."""
        return self.normalizer.encode_sparse(sparse, self.normalizer.find_origin(sparse))

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        frames = []
        for frame in self.encode(sparse).split(1, 1):
            prediction, state = self.step_frame(frame, state)
            frames.append(prediction[:, :1])
        count = sparse.shape[1] if newest is None else newest
        return self.normalizer.decode_rotations(torch.cat(frames[-count:], 1), sparse[:, -count:]), state

    def compute_training_outputs(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Run over a few frames without gradients, then predict with gradients; see MotionModel.

        The number of frames without gradients is random. The last step predicts the window's last W frames.
        """
        now = self.frames - self.horizon
        begin = now - int(torch.randint(now - self.context + 1, ()))
        encoded = self.encode(sparse)
        past = slice(begin - self.context, begin)
        motion = self.normalizer.encode(true_frames)[..., SPARSE_DIM:][..., ROTATION]
        drawn = distributed.draw_rows(torch.rand_like, true_frames[:, past][:, :1, 0])
        has_past = (drawn >= FRESH_FRACTION).to(true_frames.dtype)  # the other windows start without a past
        if self.true_start:
            has_past = torch.ones_like(has_past)
            predicted = motion[:, begin - 1 : begin - 1 + self.horizon]
            state = state | {"prediction": predicted, "predicted": has_past}
        state = state | {
            "sparse": has_past[..., None] * encoded[:, past],
            "motion": has_past[..., None] * motion[:, past],
            "started": has_past,
        }
        training = self.training
        self.train(training and self.own_dropout)
        with torch.no_grad():
            for index in range(begin, now):
                _, state = self.step_frame(encoded[:, index : index + 1], state)
        self.train(training)
        torch.clear_autocast_cache()  # weights that were cast without a gradient would have none below
        prediction, state = self.step_frame(encoded[:, now : now + 1], state)
        return TrainingOutputs(self.normalizer.decode_rotations(prediction, sparse[:, now:]), state, {})
