"""The memory slot: what the backbone is told of the past, and what is kept for the next call.

A memory gives the backbone its blocks (`block`), turns the buffers of past frames into what those blocks
see (`recall`), and updates its buffers after the network's output (`remember`). All in network space.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.flop_counter import register_flop_formula

from memmlp.body import MOTION_DIM, SPARSE_DIM
from memmlp.errors import InputError
from memmlp.features import Frame
from memmlp.layers import MLPBlock, PlainFusion, ResidualFusion
from memmlp.vqvae import VQVAE, straight_through

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

    value: a number in [0, 1], or "sampled" to draw at inference as in training. ONNX has the mean of draws.
    """

    MEAN = 0.5

    def __init__(self, value: float | str):
        super().__init__()
        self.value = value

    @property
    def sampled(self) -> bool:
        """Whether m is drawn at inference."""
        return isinstance(self.value, str)

    def forward(self, like: Tensor) -> Tensor | float:
        """m, broadcastable to (B, T, k)."""
        if self.training or isinstance(self.value, str):
            return torch.rand_like(like)
        return self.value


class ProjectedFeature(nn.Module):
    """A memory feature made of projections."""


class CodeFeature(ProjectedFeature):
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


class NoCodesFeature(ProjectedFeature):
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
    """A block that computes its memory feature from what is recalled of the past and takes it in."""

    def __init__(self, feature: nn.Module, fusion: ResidualFusion | PlainFusion):
        super().__init__()
        self.feature = feature
        self.fusion = fusion

    def forward(self, h: Tensor, past: Past | Recurred) -> Tensor:
        """(B, T, d) -> (B, T, d)."""
        return self.fusion.fuse(h, self.feature(past))


class Memory(nn.Module):
    """The slot's interface; as it stands, nothing is kept and nothing recalled.

    Attributes:
        uses_codes: wants a frozen VQ-VAE. trains_codes: has one of its own, trained with the network.
        shift: frames by which the past ends before the newest and a training step moves; 0 without a past.
        length: frames of inputs in the buffer, the last one just before the new ones.
        frames: T, the window's length.
        settled: what is recalled of a frame never changes, so that a stream may compute it once.
    """

    uses_codes: ClassVar[bool] = False
    trains_codes: ClassVar[bool] = False
    shift: int
    length: int
    frames: int
    settled: bool = True

    def block(self, layer: int) -> nn.Module:
        """The backbone's block of that layer (1-based)."""
        raise NotImplementedError

    def memory_block(self) -> nn.Module:
        """One more block that takes a memory feature in: for the predictor's branches (Table 8)."""
        raise NotImplementedError

    def initial_state(self, batch: int) -> State:
        """What is kept at a fresh start: zeros."""
        return {}

    def true_state(self, sparse: Tensor, motion: Tensor) -> State:
        """The state after inputs (B, length, 54) with the true motion (B, length, 198): teacher forcing."""
        return {}

    def needed(self, new: int) -> int:
        """How many of the output's newest frames `remember` looks at."""
        return 0

    def recall(self, sparse: Tensor, state: State, new: int) -> Past | Recurred | None:
        """What the blocks see at inputs (B, length + new, 54) whose last `new` frames are new."""
        return None

    def remember(self, motion: Tensor, past: Past | Recurred | None, state: State, new: int) -> State:
        """The state after an output (B, at least `needed`, 198) whose last `new` frames are new."""
        return {}

    def terms(self, frames: Tensor, frame: Frame) -> dict[str, Tensor]:
        """Losses of its own at true world frames (B, T, 252), added to the network's."""
        return {}


class NoMemory(Memory):
    """The empty slot: plain blocks, no past, no state."""

    def __init__(self, *, hidden: int, frames: int, depth: int, codes: VQVAE | None = None):
        super().__init__()
        self.hidden, self.frames = hidden, frames
        self.shift = 0
        self.length = frames - 1

    def block(self, layer: int) -> nn.Module:
        """The backbone's block of that layer (1-based)."""
        return MLPBlock(self.hidden, self.frames)

    def memory_block(self) -> nn.Module:
        """There is none. Raises InputError."""
        raise InputError("memory=none has no memory blocks: allowed is a predictor without memory")


class FeatureMemory(Memory):
    """A memory that gives some blocks a feature to take in.

    Args:
        layers: the backbone's layers (1-based) that get a memory feature.
        width: k, the width of the memory feature.
        fusion: "residual" or "plain".
        hidden, frames, depth: the backbone's d, T and L.
    """

    def __init__(
        self, layers: Sequence[int], width: int, fusion: str, *, hidden: int, frames: int, depth: int
    ):
        super().__init__()
        if not set(layers) <= set(range(1, depth + 1)):
            raise InputError(f"memory.layers: {list(layers)} is not within the backbone's 1..{depth}")
        self.layers, self.width, self.fusion = tuple(layers), width, FUSIONS[fusion]
        self.hidden, self.frames = hidden, frames

    def block(self, layer: int) -> nn.Module:
        """The backbone's block of that layer (1-based)."""
        return self.memory_block() if layer in self.layers else MLPBlock(self.hidden, self.frames)

    def memory_block(self) -> nn.Module:
        """A block that takes a memory feature in."""
        return MemoryBlock(self.feature(), self.fusion(self.hidden, self.frames, self.width))

    def feature(self) -> nn.Module:
        """The module that makes a block's memory feature of what `recall` gives."""
        raise NotImplementedError


class NoCodesMemory(FeatureMemory):
    """Memory of the network's own past without code-vectors (Table 11).

    Args:
        layers: the backbone's layers (1-based) that get a memory feature.
        width: k, the width of the memory feature.
        shift: "frame" (the window that ends one frame ago) or "window" (the one that ends T frames ago).
        history: a past frame's motion as "first" estimated, when it was the newest, or its "latest" estimate.
        fusion: "residual" or "plain".
        blend: m at inference, in [0, 1], or "sampled"; `memory.blend.value` changes it in a trained network.
        hidden, frames, depth: the backbone's d, T and L. codes: the frozen VQ-VAE.
    """

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
        super().__init__(layers, width, fusion, hidden=hidden, frames=frames, depth=depth)
        self.history, self.blend = history, Blend(blend)
        self.settled = history == "first"
        self.shift = {"frame": 1, "window": frames}[shift]
        self.length = frames + self.shift - 1

    def feature(self) -> nn.Module:
        """The module that makes a block's memory feature."""
        return NoCodesFeature(self.width, self.blend)

    def initial_state(self, batch: int) -> State:
        """Zeros: the paper's fallback where there is no previous prediction."""
        return {"motion": torch.zeros(batch, self.length, MOTION_DIM)}

    def true_state(self, sparse: Tensor, motion: Tensor) -> State:
        """The true motion (B, length, 198) as history: teacher forcing."""
        return {"motion": motion}

    def needed(self, new: int) -> int:
        """How many of the output's newest frames `remember` looks at."""
        return self.frames if self.history == "latest" else new

    def recall(self, sparse: Tensor, state: State, new: int) -> Past:
        """The T frames that end one shift before the newest, of inputs (B, length + new, 54)."""
        start = min(new, self.shift) - 1
        view = slice(start, start + self.frames)
        sparse, motion = sparse[:, view], state["motion"][:, view]
        return Past(sparse, motion, self.code_vectors(sparse, motion))

    def code_vectors(self, sparse: Tensor, motion: Tensor) -> Tensor:
        """None of them: (B, T, 0)."""
        return sparse[..., :0]

    def remember(self, motion: Tensor, past: Past | Recurred | None, state: State, new: int) -> State:
        """The state after an output (B, at least `needed`, 198) whose last `new` frames are new."""
        buffer = torch.cat([state["motion"], motion[:, -new:]], 1)[:, -self.length :]
        if self.history == "latest":
            buffer = torch.cat([buffer[:, : self.length - self.frames], motion], 1)
        return {"motion": buffer}


class VQMemory(NoCodesMemory):
    """Code-vectors beside the network's own past (Sec. 3.2.1), whatever VQ-VAE they come from.

    One code-vector per frame of the past window, shared by all memory blocks (reading 4).
    """

    codes: VQVAE

    def feature(self) -> nn.Module:
        """The module that makes a block's memory feature."""
        return CodeFeature(self.width, self.codes.width, self.blend)

    def code_vectors(self, sparse: Tensor, motion: Tensor) -> Tensor:
        """(B, T, code width) for inputs (B, T, 54) and motion (B, T, 198)."""
        return self.codes.code_vectors(sparse, motion)


class CodeMemory(VQMemory):
    """The paper's memory: the VQ-VAE is trained before and frozen."""

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


class JointCodeMemory(VQMemory):
    """A VQ-VAE of the network's own, trained with it from scratch (App. A: worse than the frozen one).

    Its loss, on the true frames of the window, is added as it is: it is no task of Eq. 5, and an
    uncertainty weight on a codebook loss that goes to zero would grow without bound. The network's loss
    reaches its encoder by the straight-through gradient of the code-vectors.

    Args:
        vqvae: makes the VQ-VAE.
    """

    trains_codes: ClassVar[bool] = True

    def __init__(self, *args, vqvae: Callable[[], VQVAE], codes: VQVAE | None = None, **kwargs):
        super().__init__(*args, **kwargs)
        self.codes = vqvae()

    def code_vectors(self, sparse: Tensor, motion: Tensor) -> Tensor:
        """(B, T, code width) for inputs (B, T, 54) and motion (B, T, 198), in training straight-through."""
        if not self.training:
            return super().code_vectors(sparse, motion)
        latent = self.codes.encoder(torch.cat([sparse, motion], -1))
        return straight_through(latent, self.codes.codebook(latent)[0])

    def terms(self, frames: Tensor, frame: Frame) -> dict[str, Tensor]:
        """Eq. 1 of the VQ-VAE's reconstruction and its codebook's loss; an EMA codebook learns here."""
        terms, _ = self.codes.loss_terms(frame.encode(frames).flatten(0, 1), frame)
        return {f"vqvae_{name}": term for name, term in terms.items()}


class Recurred(NamedTuple):
    """SiLU of the recurrent layers' outputs in the window (B, blocks, T, k), and what they carry on."""

    features: Tensor
    carried: State


class Recurrence(nn.Module):
    """LayerNorm of the sparse features, a recurrent layer, SiLU (App. A, reading 19).

    Attributes:
        kind: the recurrent layer. carried: names of its states, the hidden one first.
    """

    kind: ClassVar[Callable[..., nn.RNNBase]]
    carried: ClassVar[tuple[str, ...]]

    def __init__(self, width: int):
        super().__init__()
        self.norm = nn.LayerNorm(SPARSE_DIM)
        self.first = nn.Linear(SPARSE_DIM, width)
        self.layer = self.kind(SPARSE_DIM, width, batch_first=True)

    def begin(self, sparse: Tensor) -> Tensor:
        """The hidden state (B, k) that a training window starts from, of the input (B, 54) before it."""
        return self.first(self.norm(sparse))

    def forward(self, sparse: Tensor, carried: Sequence[Tensor]) -> tuple[Tensor, Sequence[Tensor]]:
        """Inputs (B, n, 54) and states (B, k) -> features (B, n, k) and the states after them."""
        with torch.autocast(sparse.device.type, enabled=False):  # not every CPU has an LSTM in bfloat16
            output, states = self.run(self.norm(sparse), [state.contiguous()[None] for state in carried])
        return F.silu(output), [state[0] for state in states]

    def run(self, x: Tensor, states: Sequence[Tensor]) -> tuple[Tensor, Sequence[Tensor]]:
        """The recurrent layer, its states (1, B, k) in a sequence."""
        raise NotImplementedError


@register_flop_formula(torch.ops.aten.mkldnn_rnn_layer)
def lstm_flops(x: Sequence[int], to_gates: Sequence[int], again: Sequence[int], *shapes, **rest) -> int:
    """FLOPs of a CPU's LSTM, one operation that the counter does not know, from the shapes of its arguments.

    x is (n, B, inputs), the weights (4 k, inputs) and (4 k, k).
    """
    return 2 * x[0] * x[1] * (to_gates[0] * to_gates[1] + again[0] * again[1])


class LSTM(Recurrence):
    """Hidden and cell state."""

    kind = nn.LSTM
    carried = ("hidden", "cell")

    def run(self, x: Tensor, states: Sequence[Tensor]) -> tuple[Tensor, Sequence[Tensor]]:
        """The recurrent layer, its states (1, B, k) in a sequence."""
        return self.layer(x, tuple(states))


class GRU(Recurrence):
    """Hidden state alone."""

    kind = nn.GRU
    carried = ("hidden",)

    def run(self, x: Tensor, states: Sequence[Tensor]) -> tuple[Tensor, Sequence[Tensor]]:
        """The recurrent layer, its states (1, B, k) in a sequence."""
        output, hidden = self.layer(x, states[0])
        return output, [hidden]


class RecurredFeature(nn.Module):
    """The feature of a memory's recurrent layer of that index."""

    def __init__(self, index: int):
        super().__init__()
        self.index = index

    def forward(self, past: Recurred) -> Tensor:
        """The memory feature (B, T, k)."""
        return past.features[:, self.index]


class RecurrentMemory(FeatureMemory):
    """A recurrent layer for each block in place of the paper's memory (Table 15, reading 19).

    It runs once over each frame, so its outputs for the window's older frames are kept beside its states:
    a stream taken frame by frame is then the same as one taken in larger steps. A training call takes a
    whole window. With teacher forcing the hidden state starts from the last input before the window,
    projected, and the cell at zero (`true_state`); else, and in evaluation, states are carried from call to
    call, zeros at a fresh start.

    Args:
        layers, width, fusion, hidden, frames, depth: see FeatureMemory; the width is the layer's hidden size.
    """

    recurrence: ClassVar[type[Recurrence]]

    def __init__(
        self,
        layers: Sequence[int],
        width: int,
        fusion: str,
        *,
        hidden: int,
        frames: int,
        depth: int,
        codes: VQVAE | None = None,
    ):
        super().__init__(layers, width, fusion, hidden=hidden, frames=frames, depth=depth)
        self.recurrences = nn.ModuleList()
        self.shift = frames
        self.length = frames - 1

    def feature(self) -> nn.Module:
        """One more recurrent layer; the module that looks its output up."""
        self.recurrences.append(self.recurrence(self.width))
        return RecurredFeature(len(self.recurrences) - 1)

    def initial_state(self, batch: int) -> State:
        """Zeros: states (B, blocks, k), and features (B, blocks, T - 1, k) of the frames before."""
        blocks = len(self.recurrences)
        states = {name: torch.zeros(batch, blocks, self.width) for name in self.recurrence.carried}
        return states | {"features": torch.zeros(batch, blocks, self.frames - 1, self.width)}

    def true_state(self, sparse: Tensor, motion: Tensor) -> State:
        """Hidden states from the last of inputs (B, length, 54)."""
        hidden = torch.stack([layer.begin(sparse[:, -1]) for layer in self._layers()], 1)
        return {"hidden": hidden.float()}

    def recall(self, sparse: Tensor, state: State, new: int) -> Recurred:
        """The layers' features, those of the `new` frames made now."""
        features, states = [], []
        for index, layer in enumerate(self._layers()):
            carried = [state[name][:, index] for name in layer.carried]
            made, after = layer(sparse[:, -new:], carried)
            features.append(made)
            states.append(after)
        window = torch.cat([state["features"], torch.stack(features, 1)], 2)[:, :, -self.frames :]
        names = self.recurrence.carried
        carried_on = {
            name: torch.stack(of, 1) for name, of in zip(names, zip(*states, strict=True), strict=True)
        }
        return Recurred(window, carried_on)

    def remember(self, motion: Tensor, past: Past | Recurred | None, state: State, new: int) -> State:
        """The states after the newest frame, and the features of the last T - 1 frames."""
        assert isinstance(past, Recurred)
        return past.carried | {"features": past.features[:, :, 1:]}

    def _layers(self) -> list[Recurrence]:
        return [layer for layer in self.recurrences if isinstance(layer, Recurrence)]


class LSTMMemory(RecurrentMemory):
    """Table 15's LSTM-MB."""

    recurrence = LSTM


class GRUMemory(RecurrentMemory):
    """Table 15's GRU-MB."""

    recurrence = GRU
