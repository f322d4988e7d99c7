"""Mem-MLP, the network of Sec. 3.2."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common.components import component, find_chosen_settings
from memmlp.common.settings import Settings, at_least, setting, tuned
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.layers import MLPBlock, PlainFusion
from memmlp.networks.memory import Memory, MemoryBlock
from memmlp.networks.motion_model import (
    MotionModel,
    State,
    StreamingGraph,
    TrainingOutputs,
    fill_past,
    slide_window,
)
from memmlp.networks.predictor import Branch, Predictor
from memmlp.networks.streaming import OneFrameNormalizer, make_linear
from memmlp.networks.vqvae import VQVAE


class StreamingBlock(nn.Module):
    """An MLP block of a streaming graph.

    A memory feature's contribution is computed in advance: in [h; z] W = h W_h + z W_z, the term z W_z is
    known when a frame enters.

    Args:
        block: the network's block, or a memory block's fusion.
        index: the index of the block's contribution; None for a block without memory.

    Attributes:
        feature_part: computes the contribution (1, d) of a feature (1, k), bias included.
    """

    feature_part: nn.Linear
    merge: nn.Linear

    def __init__(self, block: MLPBlock, index: int | None = None):
        super().__init__()
        self.time_norm, self.time_mix = block.time_norm, block.time_mix
        self.norm, self.linear = block.norm, block.linear
        self.index, self.plain = index, isinstance(block, PlainFusion)
        if index is not None:
            name = "merge" if self.plain else "linear"
            layer, hidden = getattr(block, name), block.norm.normalized_shape[0]
            setattr(self, name, make_linear(layer.weight[:, :hidden]))
            self.feature_part = make_linear(layer.weight[:, hidden:], layer.bias)

    def forward(self, h: Tensor, contributions: Sequence[Tensor], newest: bool = False) -> Tensor:
        """Map the hidden state (T, d) to the block's output (T, d).

        Args:
            h: the hidden state (T, d).
            contributions: for each memory block, its feature's contribution to the linear layer (T, d).
            newest: whether to compute only the newest frame's output (1, d).
        """

        def pick(window: Tensor) -> Tensor:
            return window[-1:] if newest else window

        mix = self.time_mix
        h = pick(h) + F.silu(torch.addmm(pick(mix.bias), pick(mix.weight), self.time_norm(h)))
        linear = self.linear(self.norm(h))
        if self.index is None:
            return h + F.silu(linear)
        contribution = pick(contributions[self.index])
        if self.plain:
            return self.merge(h + F.silu(linear)) + contribution
        return h + F.silu(linear + contribution)


class StreamingBranch(nn.Module):
    """A predictor's branch in a streaming graph; its last layers compute only the newest frame."""

    def __init__(self, blocks: Sequence[StreamingBlock], linear: nn.Linear):
        super().__init__()
        self.blocks, self.linear = nn.ModuleList(blocks), linear

    def forward(self, h: Tensor, contributions: Sequence[Tensor], count: int) -> Tensor:
        """Map the window (T, d) to the newest frame's outputs (1, size); `count` is always 1."""
        for index, block in enumerate(self.blocks, 1):
            h = block(h, contributions, index == len(self.blocks))
        return self.linear(h[-1:])


class MemMLPGraph(StreamingGraph):
    """Mem-MLP's streaming graph."""

    float32_modules = (
        "conversions",
        "stem",
        "recall.memory.recurrences",
        "recall.memory.codes",
        "recall.whole",
        "predictor.rotation.linear",
        "predictor.position.linear",
    )
    int16_modules = ("blocks", "predictor")

    @classmethod
    def fits(cls, model: Any) -> bool:
        """Return whether the predictor consists of branches; other predictors cannot be streamed."""
        return all(isinstance(part, Branch) for part in model.predictor.children())

    def build(self, model: Any) -> None:
        self.conversions = OneFrameNormalizer(model.normalizer)
        self.stem = model.stem
        features: list[nn.Module] = []
        parts: list[nn.Module] = []

        def convert(block: Any) -> StreamingBlock:
            if not isinstance(block, MemoryBlock):
                return StreamingBlock(block)
            streaming_block = StreamingBlock(block.fusion, len(parts))
            features.append(block.feature)
            parts.append(streaming_block.feature_part)
            return streaming_block

        self.blocks = nn.ModuleList(map(convert, model.blocks))
        self.predictor = model.predictor
        for name, branch in list(model.predictor.named_children()):
            setattr(self.predictor, name, StreamingBranch(list(map(convert, branch.blocks)), branch.linear))
        self.recall = model.memory.streaming_recall(model.memory, features, parts)
        self.contributions = [f"memory.{index}" for index in range(len(parts))]

    def windows(self) -> State:
        """Return zeros for windows (T, d) of stem outputs and contributions, and the memory's state."""
        memory, window = self.recall.memory, torch.zeros(self.frames, self.stem.out_features)
        return {
            "sparse": torch.zeros(1, memory.past_frames, SPARSE_DIM),
            **{name: window.clone() for name in ("stem", *self.contributions)},
            **memory.initial_state(1),
        }

    def step(self, sparse: Tensor, state: State, is_first_step: Tensor) -> tuple[Tensor, State]:
        memory = self.recall.memory
        origin = self.normalizer.find_origin(sparse)
        encoded = self.conversions.encode_sparse(sparse, origin)
        queue = torch.cat([fill_past(state["sparse"], encoded, is_first_step), encoded[None]], 1)
        past = memory.recall(queue, state, 1)
        stem = self.stem(encoded)
        kept = {"stem": slide_window(state["stem"], stem, stem, is_first_step)}
        for name, contribution, before in zip(self.contributions, *self.recall(past), strict=True):
            kept[name] = slide_window(state[name], contribution, before, is_first_step)
        h, *contributions = kept.values()
        for block in self.blocks:
            h = block(h, contributions)
        motion = self.predictor(h, contributions, sparse, self.normalizer, 1)
        kept |= memory.remember(motion[None], past, state, 1) | {"sparse": queue[:, 1:]}
        return self.conversions.decode_motion(motion, origin), kept


@component("model", "mem_mlp", builds="MemMLP")
@dataclass
class MemMLPSettings(Settings):
    """Mem-MLP's backbone (Sec. 3.2), with slots for memory, predictor and hand term."""

    frames: int = setting(at_least(2), tiny=11, small=41, paper=41)  # T, the number of frames in a window
    # d, the width of the hidden state
    width: int = setting(at_least(1), tiny=16, small=128, paper=512, width_fraction=1)
    depth: int = setting(at_least(1), 8)  # L, the number of blocks

    recipe: ClassVar = tuned(8.0e-3)
    kinematic: ClassVar[str] = "kinematic predictor=rotation_only hand=off"

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        for slot, words in (
            ("memory", ", or none for no memory"),
            ("predictor", ""),
            ("hand", ", or off for no term"),
        ):
            if config[slot] is None:
                yield f"{slot}: must be one of its options{words}, since model=mem_mlp has this slot"
                return
        if config["prerequisite"] is not None:
            yield f"prerequisite={config['prerequisite']['name']}: must be null with model=mem_mlp"
        memory, model, rollout = config["memory"], config["model"], config["rollout"]
        layers = list(memory.get("layers", []))
        if layers and max(layers) > model["depth"]:
            yield f"memory.layers={layers}: must be at most model.depth={model['depth']}"
        loss, predictor = find_chosen_settings(config, "loss"), find_chosen_settings(config, "predictor")
        if getattr(loss, "complete", False):
            name, alone = config["loss"]["name"], "predictor=rotation_only hand=off"
            if not getattr(loss, "rotations_alone", False):
                yield f"loss={name}: must be uncertainty or manual, or with {alone} a rotation-only loss"
            elif getattr(predictor, "positions", True) or config["hand"]["name"] != "off":
                yield f"loss={name}: must be uncertainty or manual, since it needs {alone}"
        if getattr(predictor, "memory_blocks", False) and not layers:
            yield f"predictor={config['predictor']['name']}: must not have memory blocks with memory=none"
        if memory["name"] == "none" and rollout["name"] == "own_predictions":
            yield "rollout=own_predictions: must be teacher_forcing or streams with memory=none"
        passes, frames = rollout.get("max_passes", model["frames"]), model["frames"]
        if memory.get("shift") == "frame" and passes < frames:
            yield (
                f"rollout.max_passes={passes}: must be at least model.frames={frames} with "
                "memory.shift=frame, since a call fills one frame; or set memory.shift=window"
            )
        if config["evaluation"]["ik"] == "lbfgs" and not getattr(predictor, "positions", True):
            yield "evaluation.ik=lbfgs: must be off or arms, since the predictor does not have positions"


class MemMLP(MotionModel):
    """The network of Sec. 3.2: a linear stem, a backbone of MLP and memory blocks, and a predictor.

    Args:
        normalizer: converts between the world and network space.
        memory: the memory in the memory slot.
        predictor: the predictor in the predictor slot.
        frames: T, the window's length.
        hidden: d, the width of the hidden state.
        depth: L, the number of the backbone's blocks.
    """

    graph = MemMLPGraph
    advance_frames = MotionModel.advance_windows

    def __init__(
        self,
        normalizer: Normalizer,
        memory: Memory,
        predictor: Predictor,
        *,
        frames: int,
        hidden: int,
        depth: int,
    ):
        super().__init__(normalizer, frames)
        self.hidden = hidden
        self.memory, self.shift, self.settled = memory, memory.shift, memory.settled
        self.stem = nn.Linear(SPARSE_DIM, hidden)
        self.blocks = nn.ModuleList(memory.make_block(layer) for layer in range(1, depth + 1))
        self.predictor = predictor
        self.branches = predictor.branches

    @classmethod
    def assemble(
        cls,
        normalizer: Normalizer,
        codes: VQVAE | None,
        *,
        settings: MemMLPSettings,
        memory: Callable[..., Memory],
        predictor: Callable[..., Predictor],
    ) -> MemMLP:
        """Build the network with random weights.

        Args:
            normalizer: converts between the world and network space.
            codes: the frozen VQ-VAE; None if the memory does not use one.
            settings: the backbone's sizes.
            memory: makes the memory, given `codes`, `depth`, `hidden` and `frames`.
            predictor: makes the predictor, given `memory_block`, `hidden` and `frames`.
        """
        sizes = {"hidden": settings.width, "frames": settings.frames}
        slot = memory(codes=codes, depth=settings.depth, **sizes)
        branches = predictor(memory_block=slot.make_memory_block, **sizes)
        return cls(normalizer, slot, branches, depth=settings.depth, **sizes)

    @property
    def past_frames(self) -> int:
        return self.memory.past_frames

    @property
    def frames_per_call(self) -> int:  # type: ignore[override]
        return self.memory.frames_per_call

    def count_past(self, new: int) -> int:
        return self.memory.count_past(new)

    def initial_state(self, batch: int = 1) -> State:
        kept = self.memory.initial_state(batch)
        return super().initial_state(batch) | {name: t.to(self.normalizer.mean) for name, t in kept.items()}

    def true_state(self, frames: Tensor) -> State:
        sparse, motion = frames[..., :SPARSE_DIM], frames[..., SPARSE_DIM:]
        origin = self.normalizer.find_origin(sparse)
        newest = self.normalizer.encode_sparse(sparse[:, -1], origin[:, -1])
        true = self.memory.true_state(newest, self.normalizer.encode_motion(motion, origin))
        return super().true_state(frames) | true

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Process the newest frames; see MotionModel.

        By default all T frames are returned. If fewer frames are requested, the predictor's last blocks skip
        the remaining frames.
        """
        new = sparse.shape[1]
        inputs, kept = self.append_inputs(sparse, state)
        origin = self.normalizer.find_origin(inputs)
        encoded = self.normalizer.encode_sparse(inputs, origin)
        past = self.memory.recall(encoded, state, new)
        h = self.stem(encoded[:, -self.frames :])
        for block in self.blocks:
            h = block(h, past)
        count = self.frames if newest is None else newest
        computed_count = max(count, self.memory.count_needed(new))
        motion = self.predictor(h, past, inputs[:, -self.frames :], self.normalizer, computed_count)
        kept |= self.memory.remember(motion, past, state, new)
        return self.normalizer.decode_motion(motion[:, -count:], origin[:, -count:]), kept

    def compute_training_outputs(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Predict the motion; a jointly trained VQ-VAE adds its losses."""
        motion, kept = self.advance(sparse, state)
        return TrainingOutputs(motion, kept, self.memory.auxiliary_losses(true_frames, self.normalizer))
