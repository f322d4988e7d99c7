"""The live stream with nothing computed twice: the numbers of `MemMLP.advance` a frame at a time, less work.

What depends on one frame alone is computed when the frame enters and carried in the state: the stem's
output, and of each memory block the share that its memory feature has in the block's linear layer, with
the code-vectors and projections before it. Only the mixing over frames, and what follows it, is left.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from memmlp.body import SPARSE_DIM
from memmlp.errors import InputError
from memmlp.memory import MemoryBlock, State
from memmlp.model import MemMLP


class Injected(nn.Module):
    """A memory block whose memory feature's share was computed before."""

    def __init__(self, block: MemoryBlock, index: int):
        super().__init__()
        self.fusion, self.index = block.fusion, index

    def forward(self, h: Tensor, injections: list[Tensor]) -> Tensor:
        """(B, T, d) and the shares (B, T, d) of all memory blocks -> (B, T, d)."""
        return self.fusion.inject(h, injections[self.index])


class Streaming(nn.Module):
    """A trained network as a live stream.

    Raises InputError where past frames' estimates change with every step (`memory.history=latest`), so
    that there is nothing to carry.
    """

    def __init__(self, model: MemMLP):
        super().__init__()
        if not model.memory.settled:
            raise InputError("memory.history=latest: past estimates change at each step; allowed is first")
        model = copy.deepcopy(model).eval()
        self.frames = model.frames
        self.frame, self.stem = model.frame, model.stem
        self.memory = model.memory.frame_by_frame()
        self.sources = nn.ModuleList(m for m in model.modules() if isinstance(m, MemoryBlock))
        inject(model, list(self.sources))
        self.blocks, self.predictor = model.blocks, model.predictor

    def initial_state(self, batch: int = 1) -> State:
        """A fresh start: zeros. At the first call the first frame stands for all before it.

        batch: 1, for this is one live stream; windows are (T - 1, d), which exports to fewer operations.
        """
        assert batch == 1
        window = torch.zeros(self.frames - 1, self.stem.out_features)
        state = {
            "started": torch.zeros(1, 1),
            "sparse": torch.zeros(1, self.memory.length, SPARSE_DIM),
            "stem": window,
            **{f"memory.{index}": window.clone() for index in range(len(self.sources))},
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
        place = self.frame.place(sparse)
        encoded = self.frame.encode_sparse(sparse, place)
        queue = _entered(state, "sparse", encoded, encoded)
        past = self.memory.recall(queue, state, 1)
        stem = self.stem(encoded[0])
        windows = {"stem": _entered(state, "stem", stem, stem)}
        for index, source in enumerate(self.sources):
            z = source.feature(past)
            share, before = (source.fusion.injection(feature[0]) for feature in (z, self.memory.before(z)))
            windows[f"memory.{index}"] = _entered(state, f"memory.{index}", share, before)
        h, *shares = windows.values()
        for block in self.blocks:
            h = block(h, shares)
        motion = self.predictor(h, shares, sparse[0], self.frame, 1)[None]
        kept = {name: window[1:] for name, window in windows.items()}
        kept |= self.memory.remember(motion, past, state, 1)
        kept |= {"sparse": queue[:, 1:], "started": state["started"].clamp_min(1)}
        return self.frame.decode_motion(motion, place), {n: t for n, t in kept.items() if t.numel()}


def _entered(state: State, name: str, entering: Tensor, before: Tensor) -> Tensor:
    """The frames (..., n, size) of a window: those carried, at a start what stands for them, and a new one."""
    carried = torch.where(state["started"] > 0, state[name], before)
    return torch.cat([carried, entering], -2)


def inject(module: nn.Module, sources: list[MemoryBlock]) -> None:
    """Put `Injected` blocks in the place of memory blocks, each with its index among the sources."""
    for name, child in module.named_children():
        if isinstance(child, MemoryBlock):
            setattr(module, name, Injected(child, sources.index(child)))
        else:
            inject(child, sources)
