"""The memory slot: what the backbone is told of the past, and what is kept for the next call.

A memory gives the backbone its blocks (`block`), turns the buffers of past frames into what those blocks
see (`recall`), and updates its buffer with the network's output (`remember`). All in network space.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.body import MOTION_DIM, SPARSE_DIM
from memmlp.errors import InputError
from memmlp.layers import MLPBlock, PlainFusion, ResidualFusion
from memmlp.vqvae import VQVAE

State = dict[str, Tensor]

FUSIONS: dict[str, type[ResidualFusion | PlainFusion]] = {"residual": ResidualFusion, "plain": PlainFusion}


class Past(NamedTuple):
    """The T frames that end one shift before the newest: inputs, the network's motion, code-vectors."""

    sparse: Tensor
    motion: Tensor
    codes: Tensor


class Projection(nn.Module):
    """Linear, LayerNorm, SiLU to the memory's width k (Sec. 3.2.1)."""

    def __init__(self, size: int, width: int):
        super().__init__()
        self.linear = nn.Linear(size, width)
        self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, size) -> (B, T, k)."""
        return F.silu(self.norm(self.linear(x)))


class Blend(nn.Module):
    """The coefficient m (reading 7): U[0, 1] per frame and channel in training, `value` at inference.

    value: a number in [0, 1], or "sampled" to draw at inference as in training.
    """

    def __init__(self, value: float | str):
        super().__init__()
        self.value = value

    def forward(self, like: Tensor) -> Tensor | float:
        """m, broadcastable to (B, T, k)."""
        if self.training or isinstance(self.value, str):
            return torch.rand_like(like)
        return self.value


class CodeFeature(nn.Module):
    """Z_l = Z_x + m * Z_theta + (1 - m) * Z_E (Sec. 3.2.1)."""

    def __init__(self, width: int, code_width: int, blend: Blend):
        super().__init__()
        self.sparse = Projection(SPARSE_DIM, width)
        self.motion = Projection(MOTION_DIM, width)
        self.codes = Projection(code_width, width)
        self.blend = blend

    def forward(self, past: Past) -> Tensor:
        """The memory feature (B, T, k)."""
        motion = self.motion(past.motion)
        m = self.blend(motion)
        return self.sparse(past.sparse) + m * motion + (1 - m) * self.codes(past.codes)


class NoCodesFeature(nn.Module):
    """Z_l = Z_x + m * Z_theta: Table 11's memory without the VQ-VAE."""

    def __init__(self, width: int, blend: Blend):
        super().__init__()
        self.sparse = Projection(SPARSE_DIM, width)
        self.motion = Projection(MOTION_DIM, width)
        self.blend = blend

    def forward(self, past: Past) -> Tensor:
        """The memory feature (B, T, k)."""
        motion = self.motion(past.motion)
        return self.sparse(past.sparse) + self.blend(motion) * motion


class MemoryBlock(nn.Module):
    """A block of the backbone that computes its memory feature from the past and takes it in."""

    def __init__(self, feature: nn.Module, fusion: ResidualFusion | PlainFusion):
        super().__init__()
        self.feature = feature
        self.fusion = fusion

    def forward(self, h: Tensor, past: Past) -> Tensor:
        """(B, T, d) -> (B, T, d)."""
        return self.fusion.fuse(h, self.feature(past))


class NoMemory(nn.Module):
    """The empty slot: plain blocks, no past, no state."""

    uses_codes: ClassVar[bool] = False

    def __init__(self, *, hidden: int, frames: int, depth: int, codes: VQVAE | None = None):
        super().__init__()
        self.hidden, self.frames = hidden, frames
        self.shift = 0
        self.length = frames - 1

    def block(self, layer: int) -> nn.Module:
        """The backbone's block of that layer (1-based)."""
        return MLPBlock(self.hidden, self.frames)

    def initial_state(self, batch: int) -> State:
        """Nothing is kept."""
        return {}

    def true_state(self, motion: Tensor) -> State:
        """Nothing is kept."""
        return {}

    def needed(self, new: int) -> int:
        """Of the output, nothing is needed."""
        return 0

    def recall(self, sparse: Tensor, state: State, new: int) -> None:
        """Nothing is recalled."""

    def remember(self, motion: Tensor, state: State, new: int) -> State:
        """Nothing is kept."""
        return {}


class NoCodesMemory(nn.Module):
    """Memory of the network's own past without code-vectors (Table 11).

    Args:
        layers: the backbone's layers (1-based) that get a memory feature.
        width: k, the width of the memory feature.
        shift: "frame" (the window that ends one frame ago) or "window" (the one that ends T frames ago).
        history: a past frame's motion as "first" estimated, when it was the newest, or its "latest" estimate.
        fusion: "residual" or "plain". blend: m at inference, in [0, 1], or "sampled".
        hidden, frames, depth: the backbone's d, T and L. codes: the frozen VQ-VAE.
    """

    uses_codes: ClassVar[bool] = False

    def __init__(
        self,
        layers: Sequence[int],
        width: int,
        shift: str,
        history: str,
        fusion: str,
        blend: float | str,
        *,
        hidden: int,
        frames: int,
        depth: int,
        codes: VQVAE | None = None,
    ):
        super().__init__()
        if not set(layers) <= set(range(1, depth + 1)):
            raise InputError(f"memory.layers: {list(layers)} is not within the backbone's 1..{depth}")
        self.layers, self.width, self.history = tuple(layers), width, history
        self.fusion, self.blend = FUSIONS[fusion], Blend(blend)
        self.hidden, self.frames = hidden, frames
        self.shift = {"frame": 1, "window": frames}[shift]
        self.length = frames + self.shift - 1  # frames in the buffers, the last one just before the new ones

    def block(self, layer: int) -> nn.Module:
        """The backbone's block of that layer (1-based)."""
        if layer not in self.layers:
            return MLPBlock(self.hidden, self.frames)
        return MemoryBlock(self.feature(), self.fusion(self.hidden, self.frames, self.width))

    def feature(self) -> nn.Module:
        """The module that makes a block's memory feature."""
        return NoCodesFeature(self.width, self.blend)

    def initial_state(self, batch: int) -> State:
        """Zeros: the paper's fallback where there is no previous prediction."""
        return {"motion": torch.zeros(batch, self.length, MOTION_DIM)}

    def true_state(self, motion: Tensor) -> State:
        """The state with the true motion (B, length, 198) as history: teacher forcing."""
        return {"motion": motion}

    def needed(self, new: int) -> int:
        """How many of the output's newest frames `remember` looks at."""
        return self.frames if self.history == "latest" else new

    def recall(self, sparse: Tensor, state: State, new: int) -> Past:
        """What the blocks see when `new` frames follow buffered inputs (B, length, 54)."""
        start = min(new, self.shift) - 1
        view = slice(start, start + self.frames)
        sparse, motion = sparse[:, view], state["motion"][:, view]
        return Past(sparse, motion, self.code_vectors(sparse, motion))

    def code_vectors(self, sparse: Tensor, motion: Tensor) -> Tensor:
        """None of them: (B, T, 0)."""
        return sparse[..., :0]

    def remember(self, motion: Tensor, state: State, new: int) -> State:
        """The state after an output (B, at least `needed`, 198) whose last `new` frames are new."""
        buffer = torch.cat([state["motion"], motion[:, -new:]], 1)[:, -self.length :]
        if self.history == "latest":
            buffer = torch.cat([buffer[:, : self.length - self.frames], motion], 1)
        return {"motion": buffer}


class CodeMemory(NoCodesMemory):
    """The paper's memory: code-vectors of a frozen VQ-VAE beside the network's own past (Sec. 3.2.1).

    One code-vector per frame of the past window, shared by all memory blocks (reading 4).
    """

    uses_codes: ClassVar[bool] = True

    def __init__(self, *args, codes: VQVAE | None = None, **kwargs):
        super().__init__(*args, **kwargs)
        assert codes is not None
        self.codes = codes.requires_grad_(False)

    def train(self, mode: bool = True) -> CodeMemory:
        """The VQ-VAE stays frozen in evaluation mode."""
        super().train(mode)
        self.codes.eval()
        return self

    def feature(self) -> nn.Module:
        """The module that makes a block's memory feature."""
        return CodeFeature(self.width, self.codes.width, self.blend)

    def code_vectors(self, sparse: Tensor, motion: Tensor) -> Tensor:
        """(B, T, code width) for inputs (B, T, 54) and motion (B, T, 198)."""
        return self.codes.code_vectors(sparse, motion)


Memory = NoMemory | NoCodesMemory
