"""Mem-MLP's streaming graph: the numbers of `MemMLP.advance`, one frame at a time.

When a frame enters, everything that depends on it alone is computed, and carried: the stem's output, the
code-vector, the projections and, for each memory block, what its memory feature contributes to the block's
linear layer. Every step then computes only the mixing over frames and what follows it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from memmlp.motion.body import SPARSE_DIM
from memmlp.networks.mem_mlp import MemMLP
from memmlp.networks.memory import State
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.predictor_slot import Branch
from memmlp.networks.streaming.blocks import Converter
from memmlp.networks.streaming.graph import StreamingGraph, filled, slid
from memmlp.networks.streaming.one_frame_normalizer import OneFrameNormalizer
from memmlp.networks.streaming.recall import recall


class MemMLPGraph(StreamingGraph):
    """Mem-MLP's streaming graph."""

    float32_modules = (
        "conversions",
        "stem",
        "recall.memory.recurrences",
        "predictor.rotation.linear",
        "predictor.position.linear",
    )

    @classmethod
    def fits(cls, model: MotionModel) -> bool:
        """Return whether the predictor is made of branches; no other predictor can be streamed."""
        return isinstance(model, MemMLP) and all(isinstance(c, Branch) for c in model.predictor.children())

    def build(self, model: MotionModel) -> None:
        """Make the graph's parts from a copy of the network."""
        assert isinstance(model, MemMLP)
        self.conversions = OneFrameNormalizer(model.normalizer)
        self.stem = model.stem
        converter = Converter()
        self.blocks = nn.ModuleList(converter.block(block) for block in model.blocks)
        self.predictor = model.predictor
        for name, branch in list(model.predictor.named_children()):
            assert isinstance(branch, Branch)
            setattr(self.predictor, name, converter.branch(branch))
        self.recall = recall(model.memory, converter.features, converter.shared)
        self.contributions = [f"memory.{index}" for index in range(len(converter.shared))]

    def windows(self) -> State:
        """Return zeros: windows (T, d) of stem outputs and of contributions, and the memory's state."""
        memory, window = self.recall.memory, torch.zeros(self.frames, self.stem.out_features)
        return {
            "sparse": torch.zeros(1, memory.past_frames, SPARSE_DIM),
            **{name: window.clone() for name in ("stem", *self.contributions)},
            **memory.initial_state(1),
        }

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and the new state."""
        memory = self.recall.memory
        origin = self.normalizer.origin(sparse)
        encoded = self.conversions.encode_sparse(sparse, origin)
        queue = torch.cat([filled(state["sparse"], encoded, fresh), encoded[None]], 1)
        past = memory.recall(queue, state, 1)
        stem = self.stem(encoded)
        kept = {"stem": slid(state["stem"], stem, stem, fresh)}
        for name, contribution, before in zip(self.contributions, *self.recall(past), strict=True):
            kept[name] = slid(state[name], contribution, before, fresh)
        h, *contributions = kept.values()
        for block in self.blocks:
            h = block(h, contributions)
        motion = self.predictor(h, contributions, sparse, self.normalizer, 1)
        kept |= memory.remember(motion[None], past, state, 1) | {"sparse": queue[:, 1:]}
        return self.conversions.decode_motion(motion, origin), kept
