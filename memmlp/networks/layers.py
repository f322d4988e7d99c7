"""The MLP block of Mem-MLP and AGRoL, and layers for several networks."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.modules.dropout import _DropoutNd

from memmlp.common import distributed
from memmlp.motion.body import (
    SPARSE_ANGULAR_VELOCITY,
    SPARSE_POSITION,
    SPARSE_ROTATION,
    SPARSE_VELOCITY,
    TRACKED,
)

FEATURES = (SPARSE_ROTATION, SPARSE_ANGULAR_VELOCITY, SPARSE_POSITION, SPARSE_VELOCITY)


def split_by_feature(sparse: Tensor) -> list[Tensor]:
    """Split inputs (..., 54) by feature, each (..., 3 trackers, n)."""
    return [sparse[..., part].unflatten(-1, (len(TRACKED), -1)) for part in FEATURES]


def select_joints(joints: Tensor, which: Sequence[int], axis: int = -2) -> Tensor:
    """Return a tensor's entries for the joints `which`. The backward is quicker than that of indexing."""
    return joints.index_select(axis, torch.tensor(which, device=joints.device))


def replace_joints(joints: Tensor, which: Sequence[int], values: Tensor, axis: int = -2) -> Tensor:
    """Return a tensor with other values for the joints `which`."""
    rows = list(joints.unbind(axis))
    for joint, row in zip(which, values.unbind(axis), strict=True):
        rows[joint] = row
    return torch.stack(rows, axis)


def take_newest(h: Tensor, count: int) -> Tensor:
    """Return the newest `count` frames of (..., T, d); all frames are returned without a slice's backward."""
    return h if count == h.shape[-2] else h[..., -count:, :]


def add_to(h: Tensor, made: Tensor) -> Tensor:
    """Return h + made, in the memory of `made` unless mixed precision gave them different types."""
    return made.add_(h) if made.dtype == h.dtype else h + made


def apply_linear(layer: nn.Linear, h: Tensor) -> Tensor:
    """Return layer(h), for batches with the bias added in place: torch first copies it to every row."""
    return layer(h) if h.dim() == 2 else F.linear(h, layer.weight).add_(layer.bias)


class TimeMix(nn.Module):
    """Mixes the frames of a window by a T x T matrix, the same for every channel (Conv1d T -> T, kernel 1).

    It is one matrix product from the left, without transposes.
    """

    def __init__(self, frames: int):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(frames, frames))
        self.bias = nn.Parameter(torch.zeros(frames, 1))
        nn.init.uniform_(self.weight, -(frames**-0.5), frames**-0.5)

    def forward(self, h: Tensor, newest: int = 0) -> Tensor:
        """Mix the frames of a window.

        Args:
            h: (B, T, d) or (T, d).
            newest: number of newest frames to return; 0 for all frames.

        Returns:
            (B, n, d) or (n, d); n is `newest`, or T for all frames.
        """
        weight, bias = (self.weight[-newest:], self.bias[-newest:]) if newest else (self.weight, self.bias)
        if h.dim() == 2:
            return torch.addmm(bias, weight, h)
        return torch.bmm(weight.expand(len(h), -1, -1), h).add_(bias)  # baddbmm would copy the bias first


class MLPBlock(nn.Module):
    """AGRoL's pre-norm MLP block: mix over time, then over channels, both residual (Sec. 3.2.1).

    Args:
        hidden: d, the width of the hidden state.
        frames: T, the window's length.
        extra: width of additional inputs to the linear layer. See docs/readings.md, no. 1.
    """

    def __init__(self, hidden: int, frames: int, extra: int = 0):
        super().__init__()
        self.time_norm = nn.LayerNorm(hidden)
        self.time_mix = TimeMix(frames)
        self.norm = nn.LayerNorm(hidden)
        self.linear = nn.Linear(hidden + extra, hidden)

    def forward(self, h: Tensor, past: object = None) -> Tensor:
        """Map the hidden state (B, T, d) to (B, T, d); `past` is ignored."""
        return self.compute_newest(h, h.shape[-2])

    def compute_newest(self, h: Tensor, count: int) -> Tensor:
        """Map (B, T, d) to the newest `count` frames (B, count, d), without computing older frames."""
        mixed = self.time_mix(self.time_norm(h), count % h.shape[-2])  # 0: all frames
        h = add_to(take_newest(h, count), F.silu(mixed))
        return add_to(h, F.silu(apply_linear(self.linear, self.norm(h))))


class ResidualFusion(MLPBlock):
    """An MLP block whose linear layer also sees the memory feature: h + f([h; z]).

    Its argument `extra` is k, the width of the memory feature. See docs/readings.md, no. 3.
    """

    def fuse(self, h: Tensor, z: Tensor) -> Tensor:
        """Map the hidden state (B, T, d) and the memory feature (B, T, k) to (B, T, d)."""
        h = add_to(h, F.silu(self.time_mix(self.time_norm(h))))
        of_h, of_z = self.linear.weight.split([h.shape[-1], z.shape[-1]], 1)  # faster than joining h and z
        made = F.linear(self.norm(h), of_h).add_(F.linear(z, of_z)).add_(self.linear.bias)
        return add_to(h, F.silu(made))


class PlainFusion(MLPBlock):
    """An MLP block followed by Linear([h; z]) from d + k to d, without a residual.

    Args:
        hidden: d.
        frames: T.
        extra: k, the width of the memory feature.
    """

    def __init__(self, hidden: int, frames: int, extra: int):
        super().__init__(hidden, frames)
        self.merge = nn.Linear(hidden + extra, hidden)

    def fuse(self, h: Tensor, z: Tensor) -> Tensor:
        """Map the hidden state (B, T, d) and the memory feature (B, T, k) to (B, T, d)."""
        return self.merge(torch.cat([super().forward(h), z], -1))


class Dropout(nn.Dropout):
    """Dropout whose values for a row do not depend on the number of processes that share a batch."""

    def forward(self, h: Tensor) -> Tensor:
        """In training, set random elements of features (B, ...) to 0, and scale the remaining elements up."""
        if not (self.training and distributed.is_batch_split()):
            return super().forward(h)
        return h * distributed.draw_rows(lambda like: F.dropout(torch.ones_like(like), self.p), h)


def find_batch_dependent_layers(module: nn.Module) -> list[str]:
    """Return the class names of layers whose result for a row depends on other rows of the batch."""

    def is_random(layer: nn.Module) -> bool:
        if isinstance(layer, nn.RNNBase):
            return layer.dropout > 0
        return isinstance(layer, _DropoutNd) and layer.p > 0 and not isinstance(layer, Dropout)

    layers = (
        layer
        for layer in module.modules()
        if isinstance(layer, _BatchNorm) or getattr(layer, "needs_whole_batch", False) or is_random(layer)
    )
    return sorted({type(layer).__name__ for layer in layers})


def step_gru(weights: Sequence[Tensor], x: Tensor, state: Tensor) -> Tensor:
    """Return a GRU layer's new state (B, d) for an input (B, n) and a state (B, d), with plain layers.

    `weights` are the layer's weights and biases, in the order of `nn.RNNBase.all_weights`.
    """
    of_input, of_state, input_bias, state_bias = weights
    return apply_gru_gates(F.linear(x, of_input, input_bias), F.linear(state, of_state, state_bias), state)


def apply_gru_gates(entering: Tensor, again: Tensor, state: Tensor) -> Tensor:
    """Return a GRU's new state (..., d) for what the input and the state add to its gates (..., 3 d)."""
    sizes = [2 * state.shape[-1], state.shape[-1]]
    (gates, new), (gates_again, new_again) = entering.split(sizes, -1), again.split(sizes, -1)
    reset, keep = torch.sigmoid(gates + gates_again).chunk(2, -1)
    new = torch.tanh(new + reset * new_again)
    return new + keep * (state - new)
