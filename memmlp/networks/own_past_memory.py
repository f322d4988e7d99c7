"""Memories of the network's own earlier motion, with code-vectors (Sec. 3.2.1) and without (Table 11)."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common import distributed
from memmlp.common.components import component
from memmlp.common.settings import one_of, setting, within
from memmlp.motion.body import MOTION_DIM, SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.layers import apply_linear
from memmlp.networks.memory import FeatureMemory, FeatureMemorySettings, Past, Recall, RecurrentPast
from memmlp.networks.motion_model import State
from memmlp.networks.vqvae import VQVAE, pass_gradients_through


class Projection(nn.Module):
    """Linear, LayerNorm and SiLU, to the memory's width k (Sec. 3.2.1).

    Args:
        size: number of inputs.
        width: k.
    """

    def __init__(self, size: int, width: int):
        super().__init__()
        self.linear = nn.Linear(size, width)
        self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, T, size) to (B, T, k)."""
        return F.silu(self.norm(apply_linear(self.linear, x)))


class Blend(nn.Module):
    """The coefficient m (docs/readings.md, no. 7), in training drawn from U[0, 1] per frame and channel.

    Args:
        value: m at inference, in [0, 1], or "sampled" to draw it also at inference. An exported ONNX file
            uses the mean of the draws, 0.5.
    """

    MEAN = 0.5

    def __init__(self, value: float | str):
        super().__init__()
        self.value = value

    def forward(self, like: Tensor) -> Tensor | float:
        """Return m: a number, or draws of the shape (B, T, k) of `like`."""
        if self.training or isinstance(self.value, str):
            return distributed.draw_rows(torch.rand_like, like)
        return self.value


class PastFeature(nn.Module):
    """The paper's memory feature Z_l = Z_x + m * Z_theta + (1 - m) * Z_E (Sec. 3.2.1).

    Args:
        width: k, the width of the feature.
        code_width: width of a code-vector; None for a feature without Z_E and VQ-VAE (Table 11).
        blend: the coefficient m.
    """

    def __init__(self, width: int, code_width: int | None, blend: Blend):
        super().__init__()
        self.sparse = Projection(SPARSE_DIM, width)
        self.motion = Projection(MOTION_DIM, width)
        self.codes = Projection(code_width, width) if code_width else None
        self.blend = blend

    def forward(self, past: Past) -> Tensor:
        """Return the memory feature (B, T, k)."""
        motion = self.motion(past.motion)
        m = self.blend(motion)
        own = m * motion if self.codes is None else torch.lerp(self.codes(past.codes), motion, m)
        return self.sparse(past.sparse) + own


class MergedProjections(nn.Module):
    """Several memory blocks' projections of the same input, computed at once.

    Args:
        parts: the blocks' projections, which have the same shape.
    """

    def __init__(self, parts: Sequence[Projection]):
        super().__init__()
        self.shape = len(parts), parts[0].norm.normalized_shape[0]
        self.weight = nn.Parameter(torch.cat([part.linear.weight for part in parts]))
        self.bias = nn.Parameter(torch.cat([part.linear.bias for part in parts]))
        self.scale = nn.Parameter(torch.stack([part.norm.weight for part in parts]))
        self.offset = nn.Parameter(torch.stack([part.norm.bias for part in parts]))

    def forward(self, x: Tensor) -> Tensor:
        """Map inputs (n, size) to the projections of all blocks (n, blocks, k)."""
        y = F.linear(x, self.weight, self.bias).view(-1, *self.shape)
        return F.silu(F.layer_norm(y, self.shape[1:]) * self.scale + self.offset)


class CodeTable(nn.Module):
    """The projections of all code-vectors, computed in advance and looked up by index.

    Args:
        parts: the blocks' projections.
        vectors: the code-vectors (K, width).
    """

    def __init__(self, parts: Sequence[Projection], vectors: Tensor):
        super().__init__()
        self.projected = nn.Parameter(MergedProjections(parts)(vectors).detach())

    def forward(self, index: Tensor) -> Tensor:
        """Map the index (1,) of a code-vector to its projections (1, blocks, k)."""
        return self.projected.index_select(0, index)


class CodeIndices(nn.Module):
    """A replacement for a VQ-VAE that returns a code-vector's index instead of the vector."""

    def __init__(self, codes: VQVAE):
        super().__init__()
        self.encoder, self.codebook = codes.encoder, codes.codebook

    def compute_code_vectors(self, sparse: Tensor, motion: Tensor) -> Tensor:
        """Return the index (1, 1) for a frame's inputs (1, 1, 54) and motion (1, 1, 198)."""
        return self.codebook.find_indices(self.encoder(torch.cat([sparse[0], motion[0]], -1)))[None]


class OwnPastRecall(Recall):
    """Recall for memories of the network's own motion; it computes all blocks' projections together."""

    def merge_features(self, features: Sequence[PastFeature]) -> None:
        """Make one feature module with the projections of all blocks; code-vectors use a table."""
        self.whole = copy.deepcopy(features[0])
        for name, child in list(self.whole.named_children()):
            if isinstance(child, Projection):
                parts = [getattr(feature, name) for feature in features]
                table = (
                    CodeTable(parts, self._replace_codes()) if name == "codes" else MergedProjections(parts)
                )
                setattr(self.whole, name, table)

    def _replace_codes(self) -> Tensor:
        """Let the memory return indices instead of code-vectors; return the vectors (K, width)."""
        assert isinstance(self.memory, VQMemory)
        codes = self.memory.codes
        # In a new dict, since the shallow copy of the memory shares its own with the network's.
        self.memory._modules = {**self.memory._modules, "codes": CodeIndices(codes)}
        return codes.codebook.vectors

    def compute_features(self, past: Past) -> Tensor:
        return self.whole(Past(*(part[0] for part in past)))


@dataclass
class OwnPastMemorySettings(FeatureMemorySettings):
    """Keys of memories that recall the network's own earlier motion."""

    # window: the past window ends T frames ago; frame: it ends one frame ago (docs/readings.md, no. 6)
    shift: str = setting(one_of("frame", "window"), "window", literal="frame")
    # first: a past frame's first estimate; latest: its latest estimate (docs/readings.md, no. 6)
    history: str = setting(one_of("first", "latest"), "first", literal="latest")
    # m at inference: a number in [0, 1], or sampled as in training; ONNX files replace sampled by 0.5
    # (docs/readings.md, no. 7)
    blend: int | float | str = setting(within(0, 1, "sampled"), 0.5)

    # frozen: the VQ-VAE is trained before the network; joint: with the network; "": without a VQ-VAE
    codes: ClassVar[str] = ""


@component("memory", "no_codes", builds="MemoryWithoutCodes")
@dataclass
class MemoryWithoutCodesSettings(OwnPastMemorySettings):
    """A memory of the network's own earlier motion, without code-vectors (Table 11)."""


@component("memory", "vq", builds="CodeMemory")
@dataclass
class CodeMemorySettings(OwnPastMemorySettings):
    """The paper's memory: code-vectors and the network's own earlier motion (Sec. 3.2.1)."""

    codes: ClassVar[str] = "frozen"


@component("memory", "vq_joint", builds="JointCodeMemory")
@dataclass
class JointCodeMemorySettings(OwnPastMemorySettings):
    """Like vq, but the VQ-VAE is trained together with the network, with an unweighted loss (App. A).

    The VQ-VAE does not have its own run, so vqvae.steps, epochs, batch, lr and weight_decay have no effect.
    """

    codes: ClassVar[str] = "joint"


class OwnPastMemory(FeatureMemory):
    """The base class of memories that recall the network's own earlier motion.

    Set `memory.blend.value` to change m in a trained network.

    Args:
        settings: the memory's keys.
        sizes: the other arguments of FeatureMemory.
    """

    streaming_recall = OwnPastRecall

    def __init__(self, settings: OwnPastMemorySettings, **sizes: Any):
        super().__init__(settings, **sizes)
        self.history, self.blend = settings.history, Blend(settings.blend)
        self.settled = self.history == "first"
        self.shift = {"frame": 1, "window": self.frames}[settings.shift]
        self.past_frames = self.frames + self.shift - 1

    @property
    def frames_per_call(self) -> int:  # type: ignore[override]
        """The maximum number of new frames whose recalled past ends before them."""
        return self.shift if self.settled else 1

    def count_past(self, new: int) -> int:
        return self.frames + max(self.shift - new, 0)

    def initial_state(self, batch: int) -> State:
        """Return zeros as the past motion, the paper's fallback without previous predictions."""
        return {"motion": torch.zeros(1, 1, 1).expand(batch, self.past_frames, MOTION_DIM)}

    def true_state(self, sparse: Tensor, motion: Tensor) -> State:
        """Return the true motion (B, past, 198) as history, for teacher forcing."""
        return {"motion": motion}

    def count_needed(self, new: int) -> int:
        return self.frames if self.history == "latest" else new

    def recall(self, sparse: Tensor, state: State, new: int) -> Past:
        """Recall T past frames; see Memory.

        They end `shift` frames before the newest frame, but at the latest just before the first new frame.
        """
        end = state["motion"].shape[1] - max(self.shift - new, 0)  # motion of new frames is not known yet
        view = slice(end - self.frames, end)
        sparse, motion = sparse[:, view].contiguous(), state["motion"][:, view].contiguous()
        return Past(sparse, motion, self.compute_code_vectors(sparse, motion))

    def compute_code_vectors(self, sparse: Tensor, motion: Tensor) -> Tensor:
        """Return code-vectors (B, T, code width) of inputs (B, T, 54) and motion (B, T, 198)."""
        raise NotImplementedError

    def remember(self, motion: Tensor, past: Past | RecurrentPast | None, state: State, new: int) -> State:
        kept = state["motion"][:, new:]
        buffer = torch.cat([kept, motion[:, -new:]], 1) if kept.shape[1] else motion
        if self.history == "latest":
            buffer = torch.cat([buffer[:, : -self.frames], motion], 1)
        return {"motion": buffer}


class MemoryWithoutCodes(OwnPastMemory):
    """A memory of the network's own earlier motion, without code-vectors (Table 11)."""

    def make_feature(self) -> nn.Module:
        return PastFeature(self.width, None, self.blend)

    def compute_code_vectors(self, sparse: Tensor, motion: Tensor) -> Tensor:
        """Return code-vectors of width 0, (B, T, 0), since this memory uses no code-vectors."""
        return sparse[..., :0]


class VQMemory(OwnPastMemory):
    """A memory of the network's own earlier motion with code-vectors, from any kind of VQ-VAE (Sec. 3.2.1).

    Each frame of the past window has one code-vector for all memory blocks (docs/readings.md, no. 4).
    """

    codes: VQVAE

    def make_feature(self) -> nn.Module:
        return PastFeature(self.width, self.codes.width, self.blend)

    def compute_code_vectors(self, sparse: Tensor, motion: Tensor) -> Tensor:
        return self.codes.compute_code_vectors(sparse, motion)


class CodeMemory(VQMemory):
    """The paper's memory, with a frozen VQ-VAE that was trained before."""

    def __init__(self, settings: CodeMemorySettings, *, codes: VQVAE | None = None, **sizes: Any):
        super().__init__(settings, **sizes)
        assert codes is not None
        self.codes = codes.requires_grad_(False)

    def train(self, mode: bool = True) -> CodeMemory:
        """Set the training mode; the VQ-VAE always stays in evaluation mode."""
        super().train(mode)
        self.codes.eval()
        return self


class JointCodeMemory(VQMemory):
    """A memory with a VQ-VAE that is trained with the network (App. A: worse than a frozen VQ-VAE).

    The VQ-VAE's loss on the window's true frames is added with weight 1. It is not a term of Eq. 5, and an
    uncertainty weight would grow without bound, since the codebook loss goes to zero. The network's loss
    reaches the encoder through the code-vectors' straight-through gradient.

    Args:
        settings: the memory's keys.
        vqvae: makes the VQ-VAE.
        sizes: the other arguments of FeatureMemory.
    """

    def __init__(self, settings: JointCodeMemorySettings, *, vqvae: Callable[[], VQVAE], **sizes: Any):
        super().__init__(settings, **sizes)
        self.codes = vqvae()

    def compute_code_vectors(self, sparse: Tensor, motion: Tensor) -> Tensor:
        """Return code-vectors (B, T, code width) of inputs (B, T, 54) and motion (B, T, 198).

        In training the code-vectors have the straight-through gradient.
        """
        if not self.training:
            return super().compute_code_vectors(sparse, motion)
        latent = self.codes.encode(torch.cat([sparse, motion], -1))
        return pass_gradients_through(latent, self.codes.codebook(latent)[0])

    def auxiliary_losses(self, frames: Tensor, normalizer: Normalizer) -> dict[str, Tensor]:
        """Return the VQ-VAE's losses on true world frames: the rotation error (Eq. 1) and the codebook loss.

        An EMA codebook learns from this call.
        """
        auxiliary_losses, _ = self.codes.compute_losses(normalizer.encode(frames).flatten(0, 1), normalizer)
        return {f"vqvae_{name}": term for name, term in auxiliary_losses.items()}
