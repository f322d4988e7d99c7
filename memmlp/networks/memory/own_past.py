"""Memories of the network's own past, with code-vectors (Sec. 3.2.1) and without."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from memmlp.motion.body import MOTION_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.memory.features import Blend, CodeFeature, NoCodesFeature, Past, Recurred, State
from memmlp.networks.memory.slot import FeatureMemory
from memmlp.networks.vqvae import VQVAE, straight_through


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

    def auxiliary_losses(self, frames: Tensor, normalizer: Normalizer) -> dict[str, Tensor]:
        """Eq. 1 of the VQ-VAE's reconstruction and its codebook's loss; an EMA codebook learns here."""
        auxiliary_losses, _ = self.codes.loss_terms(normalizer.encode(frames).flatten(0, 1), normalizer)
        return {f"vqvae_{name}": term for name, term in auxiliary_losses.items()}
