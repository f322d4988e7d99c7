"""The live stream with nothing computed twice: the numbers of `MemMLP.advance` a frame at a time, less work.

What depends on one frame alone is computed when the frame enters and carried in the state: the stem's
output, and of each memory block the share that its memory feature has in the block's linear layer, with
the code-vectors and projections before it. Only the mixing over frames, and what follows it, is left.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.body import MOTION_DIM, SPARSE_DIM
from memmlp.errors import InputError
from memmlp.features import Frame
from memmlp.memory import Memory, MemoryBlock, Past, ProjectedFeature, Recurred, RecurredFeature, State
from memmlp.model import MemMLP, WindowModel

Pieces = Sequence[Tensor]
Way = Callable[[Tensor, Tensor], Tensor]


class Injected(nn.Module):
    """A memory block whose memory feature's share was computed before."""

    def __init__(self, block: MemoryBlock, index: int):
        super().__init__()
        self.fusion, self.index = block.fusion, index

    def forward(self, h: Tensor, shares: Sequence[Tensor]) -> Tensor:
        """(T, d) and the shares (T, d) of all memory blocks -> (T, d)."""
        return self.fusion.inject(h, shares[self.index])


class Shares(nn.Module):
    """The shares that all memory blocks' features of one frame have in the blocks."""

    def __init__(self, blocks: Sequence[MemoryBlock]):
        super().__init__()
        features = [cast(ProjectedFeature | RecurredFeature, block.feature) for block in blocks]
        self.feature = features[0].together(features)
        weights, biases = zip(*(block.fusion.share() for block in blocks), strict=True)
        self.weight = nn.Parameter(torch.stack([weight.T for weight in weights]))
        self.bias = nn.Parameter(torch.stack(biases)[:, None])

    def forward(self, past: Past | Recurred, memory: Memory) -> tuple[Pieces, Pieces]:
        """Of the frame that is recalled, and of those before the first one: (1, d) a block."""
        z = self.feature(past)
        return self._of(z), self._of(memory.before(z))

    def _of(self, z: Tensor) -> Sequence[Tensor]:
        return torch.baddbmm(self.bias, z.transpose(0, 1), self.weight).unbind(0)


class Coordinates(nn.Module):
    """World <-> network space as matrices: both ways are linear for a given turn, and in cosine and sine.

    Args:
        frame: whose `encode_sparse` and `decode_motion` these are; the matrices are found by trying.
    """

    def __init__(self, frame: Frame):
        super().__init__()
        self.frame = frame
        exact = copy.deepcopy(frame).double()
        turns = exact.place(torch.zeros(1, SPARSE_DIM)).shape[-1] - 3
        inputs, motions = torch.eye(SPARSE_DIM).double(), torch.eye(MOTION_DIM + 3).double()

        def encode(x: Tensor, turn: Tensor) -> Tensor:
            return exact.encode_sparse(x, torch.cat([exact.place(x)[..., :3], turn.expand(len(x), -1)], -1))

        def decode(x: Tensor, turn: Tensor) -> Tensor:
            return exact.decode_motion(
                x[:, :MOTION_DIM], torch.cat([x[:, MOTION_DIM:], turn.expand(len(x), -1)], -1)
            )

        self.encoder, self.encoder_bias = (
            nn.Parameter(p.to(frame.mean)) for p in _matrices(encode, inputs, turns)
        )
        self.decoder, self.decoder_bias = (
            nn.Parameter(p.to(frame.mean)) for p in _matrices(decode, motions, turns)
        )

    def encode(self, sparse: Tensor, place: Tensor) -> Tensor:
        """World inputs (1, 54) of a frame whose place is (1, 3 or 5) -> network space (1, 54)."""
        return _apply(self.encoder, self.encoder_bias, sparse, place)

    def decode(self, motion: Tensor, place: Tensor) -> Tensor:
        """Network space (1, 198) -> world motion (1, 198)."""
        return _apply(self.decoder, self.decoder_bias, torch.cat([motion, place[:, :3]], -1), place)


def _matrices(way: Way, basis: Tensor, turns: int) -> tuple[Tensor, Tensor]:
    """Matrices (1 + turns, out, in), offsets (1 + turns, 1, out): the constant, then one a turn's number."""
    size = basis.shape[-1]
    tried = [torch.zeros(turns).double(), *torch.eye(turns).double()]
    offsets = torch.stack([way(torch.zeros(1, size).double(), turn) for turn in tried])
    matrices = torch.stack([way(basis, turn) - offset for turn, offset in zip(tried, offsets, strict=True)])
    offsets[1:] -= offsets[:1]
    matrices[1:] -= matrices[:1]
    return matrices.transpose(1, 2), offsets


def _apply(matrices: Tensor, offsets: Tensor, x: Tensor, place: Tensor) -> Tensor:
    """The sum of the matrices' products with x (1, in), each times its turn's number."""
    parts, out = len(matrices), matrices.shape[1]
    products = F.linear(x, matrices.reshape(parts * out, -1), offsets.reshape(-1)).view(parts, out)
    turn = torch.cat([torch.ones_like(place[:, :1]), place[:, 3:]], -1)
    return turn @ products


def streaming(model: WindowModel) -> Streaming:
    """The live stream of a trained network. Raises InputError where it has none of its own.

    That is so for reference networks, which compute whole windows as published, and where estimates of past
    frames change at each step (`memory.history=latest`), so that nothing can be carried.
    """
    if not isinstance(model, MemMLP):
        raise InputError("the streaming graph is Mem-MLP's: allowed is the whole one")
    if not model.memory.settled:
        raise InputError("memory.history=latest: estimates change at each step; allowed is the whole graph")
    return Streaming(model)


class Streaming(nn.Module):
    """A Mem-MLP as a live stream, for one stream and without gradients; see `streaming`."""

    def __init__(self, model: MemMLP):
        super().__init__()
        model = copy.deepcopy(model).eval()
        self.frames = model.frames
        self.frame, self.stem = model.frame, model.stem
        self.coordinates = Coordinates(model.frame)
        self.memory = model.memory.frame_by_frame()
        sources = [module for module in model.modules() if isinstance(module, MemoryBlock)]
        self.shares = Shares(sources) if sources else None
        self.count = len(sources)
        inject(model, sources)
        self.blocks, self.predictor = model.blocks, model.predictor
        self.requires_grad_(False)

    def initial_state(self, batch: int = 1) -> State:
        """A fresh start: zeros. At the first call the first frame stands for all before it.

        batch: 1. Windows are (T - 1, d), which exports to fewer operations.
        """
        assert batch == 1
        window = torch.zeros(self.frames - 1, self.stem.out_features)
        state = {
            "started": torch.zeros(1, 1),
            "sparse": torch.zeros(1, self.memory.length, SPARSE_DIM),
            "stem": window,
            **{f"memory.{index}": window.clone() for index in range(self.count)},
            **self.memory.initial_state(1),
        }
        return {name: tensor.to(self.stem.weight) for name, tensor in state.items() if tensor.numel()}

    def advance(self, sparse: Tensor, state: State, newest: int = 1) -> tuple[Tensor, State]:
        """Take one frame in.

        Args:
            sparse: world inputs (1, 1, 54). state: what the last call returned, or `initial_state`.
            newest: 1; no other frame is made.

        Returns:
            Motion (1, 1, 198) in the world, and the state.
        """
        state = self.memory.initial_state(1) | {"sparse": sparse[:, :0]} | state
        place = self.frame.place(sparse[0])
        encoded = self.coordinates.encode(sparse[0], place)
        queue = _entered(state, "sparse", encoded[None], encoded[None])
        past = self.memory.recall(queue, state, 1)
        stem = self.stem(encoded)
        windows = {"stem": _entered(state, "stem", stem, stem)}
        if self.shares is not None:
            for index, (share, before) in enumerate(zip(*self.shares(past, self.memory), strict=True)):
                windows[f"memory.{index}"] = _entered(state, f"memory.{index}", share, before)
        h, *shares = windows.values()
        for block in self.blocks:
            h = block(h, shares)
        motion = self.predictor(h, shares, sparse[0], self.frame, 1)
        kept = {name: window[1:] for name, window in windows.items()}
        kept |= self.memory.remember(motion[None], past, state, 1)
        kept |= {"sparse": queue[:, 1:], "started": state["started"].clamp_min(1)}
        world = self.coordinates.decode(motion, place)
        return world[None], {name: tensor for name, tensor in kept.items() if tensor.numel()}


def _entered(state: State, name: str, entering: Tensor, before: Tensor) -> Tensor:
    """A window's frames (..., n, size): those carried, at a start what stands for them, and a new one."""
    carried = torch.where(state["started"] > 0, state[name], before)
    return torch.cat([carried, entering], -2)


def inject(module: nn.Module, sources: Sequence[MemoryBlock]) -> None:
    """Put `Injected` blocks in the place of memory blocks, each with its index among the sources."""
    for name, child in module.named_children():
        if isinstance(child, MemoryBlock):
            setattr(module, name, Injected(child, sources.index(child)))
        else:
            inject(child, sources)
