"""The VQ-VAE whose frozen encoder and codebook give the memory its code-vectors (App. A, reading 5).

It works frame by frame in network space: a frame [X | Theta] (252) is encoded, quantised, and decoded
to the 132 rotations.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.motion.body import FRAME_DIM, ROTATION, SPARSE_DIM
from memmlp.motion.normalizer import Normalizer


class Quantised(NamedTuple):
    """Code-vectors (..., width), their indices (...), and the loss that ties encoder and codebook."""

    codes: Tensor
    indices: Tensor
    loss: Tensor


def straight_through(latent: Tensor, codes: Tensor) -> Tensor:
    """The codes (..., width), their gradient that of the latents (..., width)."""
    return latent + (codes - latent).detach()


class Codebook(nn.Module):
    """K code-vectors; the nearest one stands for a latent. How they are learned is the subclass' matter."""

    vectors: Tensor

    def indices(self, latent: Tensor) -> Tensor:
        """Index (...) of the code-vector nearest to a latent (..., width), in the Euclidean norm."""
        distance = self.vectors.square().sum(-1) - 2 * latent @ self.vectors.T
        return distance.argmin(-1)

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Code-vectors (..., width) and indices (...) of latents (..., width)."""
        index = self.indices(latent)
        return F.embedding(index, self.vectors), index


class EMACodebook(Codebook):
    """Code-vectors as running means of the latents assigned to them; starts on data, restarts dead codes.

    Args:
        codes, width: K and the dimension of a code-vector.
        commitment: weight of the commitment loss.
        decay: of the running means, per step.
    """

    DEAD = 1e-2  # a code that stands for fewer latents a step (running mean) is dead

    counts: Tensor
    sums: Tensor
    started: Tensor

    def __init__(self, codes: int, width: int, commitment: float, decay: float):
        super().__init__()
        self.commitment, self.decay = commitment, decay
        self.register_buffer("vectors", torch.zeros(codes, width))
        self.register_buffer("sums", torch.zeros(codes, width))
        self.register_buffer("counts", torch.zeros(codes))
        self.register_buffer("started", torch.zeros((), dtype=torch.bool))

    def learn(self, latent: Tensor) -> Quantised:
        """Quantise latents (B, width) and move the code-vectors towards them."""
        with torch.autocast(latent.device.type, enabled=False):  # running means need float32
            codes, index = self._follow(latent.detach().float())
        return Quantised(codes, index, self.commitment * F.mse_loss(latent, codes))

    def _follow(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Codes and indices of latents, after which the code-vectors move."""
        if not self.started:
            self._restart(torch.ones_like(self.counts, dtype=torch.bool), latent)
            self.started.fill_(True)
        codes, index = self(latent)
        chosen = F.one_hot(index, len(self.counts)).to(latent.dtype)
        self.counts.lerp_(chosen.sum(0), 1 - self.decay)
        self.sums.lerp_(chosen.T @ latent, 1 - self.decay)
        self._restart(self.counts < self.DEAD, latent)
        self.vectors.copy_(self.sums / self.counts[:, None])
        return codes, index

    def _restart(self, dead: Tensor, latent: Tensor) -> None:
        """Put dead codes onto random latents of the batch."""
        pick = torch.randint(len(latent), (len(dead),), device=latent.device)
        self.sums.copy_(torch.where(dead[:, None], latent[pick], self.sums))
        self.counts.copy_(torch.where(dead, torch.ones_like(self.counts), self.counts))
        self.vectors.copy_(self.sums / self.counts[:, None])


class GradientCodebook(Codebook):
    """Code-vectors as parameters, pulled to the latents by the codebook loss of van den Oord et al. 2017."""

    def __init__(self, codes: int, width: int, commitment: float, decay: float):
        super().__init__()
        self.commitment = commitment
        self.vectors = nn.Parameter(torch.empty(codes, width).uniform_(-1 / codes, 1 / codes))

    def learn(self, latent: Tensor) -> Quantised:
        """Quantise latents (B, width); the loss pulls codes to latents and latents to codes."""
        codes, index = self(latent)
        loss = F.mse_loss(codes, latent.detach()) + self.commitment * F.mse_loss(latent, codes.detach())
        return Quantised(codes, index, loss)


LearnedCodebook = EMACodebook | GradientCodebook
CODEBOOKS: dict[str, type[LearnedCodebook]] = {"ema": EMACodebook, "gradient": GradientCodebook}


class VQVAE(nn.Module):
    """Encoder, codebook and decoder on single frames.

    Args:
        codes: K. width: dimension of latents and code-vectors.
        encoder_depth, decoder_depth: number of blocks (LayerNorm, Linear, SiLU).
        commitment, decay: see the codebooks. codebook: "ema" or "gradient".
    """

    def __init__(
        self,
        codes: int = 64,
        width: int = 256,
        encoder_depth: int = 4,
        decoder_depth: int = 1,
        commitment: float = 0.25,
        decay: float = 0.99,
        codebook: str = "ema",
    ):
        super().__init__()
        self.width = width
        self.encoder = nn.Sequential(nn.Linear(FRAME_DIM, width), *_blocks(width, encoder_depth))
        self.codebook: LearnedCodebook = CODEBOOKS[codebook](codes, width, commitment, decay)
        self.decoder = nn.Sequential(*_blocks(width, decoder_depth), nn.Linear(width, ROTATION.stop))

    def code_vectors(self, sparse: Tensor, motion: Tensor) -> Tensor:
        """Code-vectors (..., width) of frames in network space: inputs (..., 54), motion (..., 198)."""
        return self.codebook(self.encoder(torch.cat([sparse, motion], -1)))[0]

    def reconstruct(self, frames: Tensor) -> tuple[Tensor, Quantised]:
        """Rotations (B, 132) of frames (B, 252), with the straight-through gradient; the codebook learns."""
        latent = self.encoder(frames)
        quantised: Quantised = self.codebook.learn(latent)
        return self.decoder(straight_through(latent, quantised.codes)), quantised

    def loss_terms(self, frames: Tensor, normalizer: Normalizer) -> tuple[dict[str, Tensor], Tensor]:
        """Eq. 1 of the reconstruction and the codebook's loss, and the chosen indices (B,); it learns.

        Args:
            frames: (B, 252) in the network space of `normalizer`.
        """
        rotations, quantised = self.reconstruct(frames)
        terms = {"rotation": rotation_error(rotations, frames, normalizer), "codebook": quantised.loss}
        return terms, quantised.indices


def rotation_error(rotations: Tensor, frames: Tensor, normalizer: Normalizer) -> Tensor:
    """Eq. 1 in the world's units, for rotations (B, 132) and frames (B, 252) of network space."""
    error = (rotations - frames[:, SPARSE_DIM:][:, ROTATION]) * normalizer.std[SPARSE_DIM:][ROTATION]
    return error.abs().sum(-1).mean()


def _blocks(width: int, depth: int) -> list[nn.Module]:
    """`depth` blocks of LayerNorm, Linear, SiLU (App. A)."""
    return [nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.SiLU()) for _ in range(depth)]
