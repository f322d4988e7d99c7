"""The VQ-VAE that provides the memory's code-vectors (App. A; docs/readings.md, no. 5).

It works frame by frame in network space: a frame [X | Theta] (252) is encoded, quantised, and decoded to the
132 rotation components.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common import distributed
from memmlp.motion.body import FRAME_DIM, ROTATION, SPARSE_DIM
from memmlp.motion.normalizer import Normalizer, use_float32


class QuantisedLatents(NamedTuple):
    """A codebook's outputs for latents in training.

    Attributes:
        codes: code-vectors (..., width).
        indices: the code-vectors' indices (...).
        loss: the codebook and commitment loss, a scalar.
    """

    codes: Tensor
    indices: Tensor
    loss: Tensor


def pass_gradients_through(latent: Tensor, codes: Tensor) -> Tensor:
    """Return the codes (..., width) with a straight-through gradient to the latents (..., width)."""
    return latent + (codes - latent).detach()


class Codebook(nn.Module):
    """K code-vectors; the nearest code-vector replaces a latent. Subclasses define how they are learned."""

    vectors: Tensor

    def find_indices(self, latent: Tensor) -> Tensor:
        """Return the index (...) of the nearest code-vector (Euclidean) for each latent (..., width)."""
        with use_float32(latent.device):  # bfloat16 would make another code-vector the nearest
            products = latent.to(self.vectors.dtype) @ self.vectors.T
            return (self.vectors.square().sum(-1) - 2 * products).argmin(-1)

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Return the code-vectors (..., width) and indices (...) of latents (..., width)."""
        index = self.find_indices(latent)
        return F.embedding(index, self.vectors), index


class EMACodebook(Codebook):
    """Code-vectors that are running means of the latents assigned to them.

    The first batch initialises them. A code with almost no assigned latents is dead, and restarts at a random
    latent of the batch.

    Args:
        codes: K, the number of code-vectors.
        width: dimension of a code-vector.
        commitment: weight of the commitment loss.
        decay: decay of the running means, per step.
    """

    DEAD = 1e-2  # a code is dead if fewer latents a step are assigned to it (running mean)

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

    def learn(self, latent: Tensor) -> QuantisedLatents:
        """Quantise latents (B, width) and move the code-vectors towards them."""
        with use_float32(latent.device):  # running means need float32
            codes, index = self._update_means(latent.detach().to(self.vectors.dtype))
        return QuantisedLatents(codes, index, self.commitment * F.mse_loss(latent, codes))

    def _update_means(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Return the codes and indices of latents (B, width), then update the code-vectors.

        If several processes share a batch, the running means cover the whole batch.
        """
        latent = distributed.gather_rows(latent)
        if not self.started:
            self._restart(torch.ones_like(self.counts, dtype=torch.bool), latent)
            self.started.fill_(True)
        codes, index = self(latent)
        chosen = F.one_hot(index, len(self.counts)).to(latent.dtype)
        self.counts.lerp_(chosen.sum(0), 1 - self.decay)
        self.sums.lerp_(chosen.T @ latent, 1 - self.decay)
        self._restart(self.counts < self.DEAD, latent)
        self.vectors.copy_(self.sums / self.counts[:, None])
        return distributed.take_local_rows(codes), distributed.take_local_rows(index)

    def _restart(self, dead: Tensor, latent: Tensor) -> None:
        """Replace the codes in the mask `dead` (K,) by random latents of the batch (B, width)."""
        pick = torch.randint(len(latent), (len(dead),), device=latent.device)
        self.sums.copy_(torch.where(dead[:, None], latent[pick], self.sums))
        self.counts.copy_(torch.where(dead, torch.ones_like(self.counts), self.counts))
        self.vectors.copy_(self.sums / self.counts[:, None])


class GradientCodebook(Codebook):
    """Code-vectors as parameters, learned by the codebook loss of van den Oord et al. 2017.

    Args:
        codes: K, the number of code-vectors.
        width: dimension of a code-vector.
        commitment: weight of the commitment loss.
        decay: not used here.
    """

    def __init__(self, codes: int, width: int, commitment: float, decay: float):
        super().__init__()
        self.commitment = commitment
        self.vectors = nn.Parameter(torch.empty(codes, width).uniform_(-1 / codes, 1 / codes))

    def learn(self, latent: Tensor) -> QuantisedLatents:
        """Quantise latents (B, width); the loss pulls codes to latents and latents to codes."""
        codes, index = self(latent)
        loss = F.mse_loss(codes, latent.detach()) + self.commitment * F.mse_loss(latent, codes.detach())
        return QuantisedLatents(codes, index, loss)


LearnedCodebook = EMACodebook | GradientCodebook
CODEBOOKS: dict[str, type[LearnedCodebook]] = {"ema": EMACodebook, "gradient": GradientCodebook}


class VQVAE(nn.Module):
    """A VQ-VAE of single frames: encoder, codebook and decoder.

    Args:
        codes: K, the number of code-vectors.
        width: dimension of latents and code-vectors.
        encoder_depth: number of the encoder's blocks (LayerNorm, Linear, SiLU).
        decoder_depth: number of the decoder's blocks.
        commitment: weight of the commitment loss.
        decay: decay of an EMA codebook's running means.
        codebook: "ema" or "gradient".
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
        self.encoder = nn.Sequential(nn.Linear(FRAME_DIM, width), *_make_blocks(width, encoder_depth))
        self.codebook: LearnedCodebook = CODEBOOKS[codebook](codes, width, commitment, decay)
        self.decoder = nn.Sequential(*_make_blocks(width, decoder_depth), nn.Linear(width, ROTATION.stop))

    def encode(self, frames: Tensor) -> Tensor:
        """Encode frames (..., 252) in network space to latents (..., width).

        The latents are always computed in float32: in lower precision, training would find other code-vectors
        than evaluation and export.
        """
        with use_float32(frames.device):
            return self.encoder(frames.to(self.codebook.vectors.dtype))

    def compute_code_vectors(self, sparse: Tensor, motion: Tensor) -> Tensor:
        """Return the code-vectors (..., width) of inputs (..., 54) and motion (..., 198) in network space."""
        return self.codebook(self.encode(torch.cat([sparse, motion], -1)))[0]

    def reconstruct(self, frames: Tensor) -> tuple[Tensor, QuantisedLatents]:
        """Reconstruct the rotations (B, 132) of frames (B, 252), with the straight-through gradient.

        An EMA codebook learns from this call.
        """
        latent = self.encode(frames)
        quantised: QuantisedLatents = self.codebook.learn(latent)
        return self.decoder(pass_gradients_through(latent, quantised.codes)), quantised

    def compute_losses(self, frames: Tensor, normalizer: Normalizer) -> tuple[dict[str, Tensor], Tensor]:
        """Return the losses by name (Eq. 1 and the codebook loss), and the chosen indices (B,).

        An EMA codebook learns from this call.

        Args:
            frames: (B, 252) in the network space of `normalizer`.
            normalizer: converts between the world and network space.
        """
        rotations, quantised = self.reconstruct(frames)
        terms = {
            "rotation": measure_rotation_error(rotations, frames, normalizer),
            "codebook": quantised.loss,
        }
        return terms, quantised.indices


def measure_rotation_error(rotations: Tensor, frames: Tensor, normalizer: Normalizer) -> Tensor:
    """Return Eq. 1 in the world's units, for rotations (B, 132) and frames (B, 252) in network space."""
    error = (rotations - frames[:, SPARSE_DIM:][:, ROTATION]) * normalizer.std[SPARSE_DIM:][ROTATION]
    return error.abs().sum(-1).mean()


def _make_blocks(width: int, depth: int) -> list[nn.Module]:
    return [nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.SiLU()) for _ in range(depth)]
