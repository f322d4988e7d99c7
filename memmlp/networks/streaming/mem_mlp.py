"""Mem-MLP's streaming graph: the numbers of `MemMLP.advance`, one frame at a time.

When a frame enters, everything that depends on it alone is computed, and carried: the stem's output, the
code-vector, the projections and, for each memory block, the share that its memory feature has in the block's
linear layer. Only the mixing over frames, and what follows it, is left for every step.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.motion.body import MOTION_DIM, SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.mem_mlp import MemMLP
from memmlp.networks.memory import State
from memmlp.networks.predictor import Branch
from memmlp.networks.streaming.blocks import Converter
from memmlp.networks.streaming.graph import StreamingGraph, filled, slid
from memmlp.networks.streaming.recall import recall
from memmlp.networks.window_model import WindowModel

Way = Callable[[Tensor, Tensor], Tensor]


class Coordinates(nn.Module):
    """The normalizer's conversions as matrices, which need few operations at a step.

    For a given turn of the coordinates both conversions are linear, and their matrices are linear in the
    turn's numbers, the cosine and sine of the heading. So the matrices are found by converting a basis.

    Args:
        normalizer: the normalizer whose `encode_sparse` and `decode_motion` these are.
    """

    def __init__(self, normalizer: Normalizer):
        super().__init__()
        self.normalizer = normalizer
        exact = copy.deepcopy(normalizer).double()
        turns = exact.origin(torch.zeros(1, SPARSE_DIM)).shape[-1] - 3
        inputs, motions = torch.eye(SPARSE_DIM).double(), torch.eye(MOTION_DIM + 3).double()

        def encode(x: Tensor, turn: Tensor) -> Tensor:
            return exact.encode_sparse(x, torch.cat([exact.origin(x)[..., :3], turn.expand(len(x), -1)], -1))

        def decode(x: Tensor, turn: Tensor) -> Tensor:
            return exact.decode_motion(
                x[:, :MOTION_DIM], torch.cat([x[:, MOTION_DIM:], turn.expand(len(x), -1)], -1)
            )

        self.encoder, self.encoder_bias = (
            nn.Parameter(p.to(normalizer.mean)) for p in _matrices(encode, inputs, turns)
        )
        self.decoder, self.decoder_bias = (
            nn.Parameter(p.to(normalizer.mean)) for p in _matrices(decode, motions, turns)
        )

    def encode(self, sparse: Tensor, origin: Tensor) -> Tensor:
        """Convert a frame's world inputs (1, 54), whose origin is (1, 3 or 5), to network space (1, 54)."""
        return _apply(self.encoder, self.encoder_bias, sparse, origin)

    def decode(self, motion: Tensor, origin: Tensor) -> Tensor:
        """Convert motion (1, 198) in network space to world motion (1, 198), given its origin (1, 3 or 5)."""
        return _apply(self.decoder, self.decoder_bias, torch.cat([motion, origin[:, :3]], -1), origin)


def _matrices(way: Way, basis: Tensor, turns: int) -> tuple[Tensor, Tensor]:
    """Find the matrices and offsets of a conversion that is linear for any given turn.

    Args:
        way: the conversion, of vectors (n, in) and a turn (turns,) to vectors (n, out).
        basis: the identity (in, in).
        turns: how many numbers a turn has.

    Returns:
        Matrices (1 + turns, out, in) and offsets (1 + turns, 1, out): first those at a turn of zeros, then
        what each of the turn's numbers adds to them.
    """
    size = basis.shape[-1]
    tried = [torch.zeros(turns).double(), *torch.eye(turns).double()]
    offsets = torch.stack([way(torch.zeros(1, size).double(), turn) for turn in tried])
    matrices = torch.stack([way(basis, turn) - offset for turn, offset in zip(tried, offsets, strict=True)])
    offsets[1:] -= offsets[:1]
    matrices[1:] -= matrices[:1]
    return matrices.transpose(1, 2), offsets


def _apply(matrices: Tensor, offsets: Tensor, x: Tensor, origin: Tensor) -> Tensor:
    """Apply the conversion to x (1, in): the sum of all matrices' products, each times its turn's number."""
    parts, out = len(matrices), matrices.shape[1]
    products = F.linear(x, matrices.reshape(parts * out, -1), offsets.reshape(-1)).view(parts, out)
    turn = torch.cat([torch.ones_like(origin[:, :1]), origin[:, 3:]], -1)
    return turn @ products


class MemMLPStream(StreamingGraph):
    """Mem-MLP's streaming graph."""

    ends = (
        "coordinates",
        "stem",
        "recall.memory.recurrences",
        "predictor.rotation.linear",
        "predictor.position.linear",
    )

    @classmethod
    def fits(cls, model: WindowModel) -> bool:
        """Return whether the predictor is made of branches, which alone can be streamed."""
        return isinstance(model, MemMLP) and all(isinstance(c, Branch) for c in model.predictor.children())

    def build(self, model: WindowModel) -> None:
        """Make the graph's parts from a copy of the network."""
        assert isinstance(model, MemMLP)
        self.coordinates = Coordinates(model.normalizer)
        self.stem = model.stem
        converter = Converter()
        self.blocks = nn.ModuleList(converter.block(block) for block in model.blocks)
        self.predictor = model.predictor
        for name, branch in list(model.predictor.named_children()):
            assert isinstance(branch, Branch)
            setattr(self.predictor, name, converter.branch(branch))
        self.recall = recall(model.memory, converter.features, converter.shared)
        self.shares = [f"memory.{index}" for index in range(len(converter.shared))]

    def windows(self) -> State:
        """Return zeros: windows of the stem's outputs and of the shares (T, d), and what the memory keeps."""
        memory, window = self.recall.memory, torch.zeros(self.frames, self.stem.out_features)
        return {
            "sparse": torch.zeros(1, memory.length, SPARSE_DIM),
            **{name: window.clone() for name in ("stem", *self.shares)},
            **memory.initial_state(1),
        }

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and what is carried on."""
        memory = self.recall.memory
        origin = self.normalizer.origin(sparse)
        encoded = self.coordinates.encode(sparse, origin)
        queue = torch.cat([filled(state["sparse"], encoded, fresh), encoded[None]], 1)
        past = memory.recall(queue, state, 1)
        stem = self.stem(encoded)
        kept = {"stem": slid(state["stem"], stem, stem, fresh)}
        for name, share, before in zip(self.shares, *self.recall(past), strict=True):
            kept[name] = slid(state[name], share, before, fresh)
        h, *shares = kept.values()
        for block in self.blocks:
            h = block(h, shares)
        motion = self.predictor(h, shares, sparse, self.normalizer, 1)
        kept |= memory.remember(motion[None], past, state, 1) | {"sparse": queue[:, 1:]}
        return self.coordinates.decode(motion, origin), kept
