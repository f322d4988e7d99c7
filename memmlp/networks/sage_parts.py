"""SAGE-Net's parts (Feng et al., CVPR 2024): VQ-VAEs of the body halves, diffusion models and decoder.

A VQ-VAE for each half encodes a window as latents. A diffusion model predicts the upper half's latents from
the inputs. A second model predicts the lower half's latents from the inputs and the upper latents. The
decoder computes rotations from both. The refiner is in memmlp.networks.refiner. All latents are (B, T // 2,
384).
"""

import math
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.motion.body import N_JOINTS, ROTATION, TRACKED
from memmlp.motion.normalizer import use_float32
from memmlp.networks.avatar_jlm import JOINT_DIM, group_by_tracker
from memmlp.networks.bodiffusion import SINES
from memmlp.networks.diffusion import TimeEmbedding
from memmlp.networks.layers import Dropout
from memmlp.networks.transformer import Attention, DiTBlock

UPPER = (0, 3, 6, 9, *range(12, 22))
LOWER = (0, 1, 2, 4, 5, 7, 8, 10, 11)
"""The joints of the body's halves; both have the root."""
LATENT = 384
BOOKS, CODES = 8, 64
DECAY = 0.99  # of how often a code is used
TEMPERATURE = 0.07  # of the contrastive loss, which is of the first two books
CONTRASTED = 2
HIDDEN = 0.01  # what stands in training for joints that are hidden


class Mixture(nn.Module):
    """Mixes the trackers' features into features of joints (a convolution of kernel 1 over the trackers).

    Args:
        joints: number of joints.
    """

    def __init__(self, joints: int):
        super().__init__()
        self.spread = nn.Linear(len(TRACKED), joints)

    def forward(self, encoded: Tensor) -> Tensor:
        """Map inputs (..., 54) to features of joints (..., J, 18)."""
        return self.spread(group_by_tracker(encoded).transpose(-1, -2)).transpose(-1, -2)


class AttentionBlock(nn.Module):
    """Attention and an MLP of four times the width, both pre-norm and residual.

    Args:
        width: d, the width of the features.
        heads: number of attention heads, a divisor of d.
        dropout: dropout rate of both parts' outputs, while training.
    """

    def __init__(self, width: int, heads: int, dropout: float):
        super().__init__()
        self.attention_norm, self.attention = nn.LayerNorm(width), Attention(width, heads)
        self.norm, self.dropout = nn.LayerNorm(width), Dropout(dropout)
        self.mlp = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, h: Tensor) -> Tensor:
        """Map features (B, T, d) to (B, T, d)."""
        return self.compute_newest(h, h.shape[-2])

    def compute_newest(self, h: Tensor, count: int) -> Tensor:
        """Map features (..., T, d) to the newest `count` frames' features, without computing older frames."""
        seen = self.attention_norm(h)
        h = h[..., -count:, :] + self.dropout(self.attention(seen[..., -count:, :], seen))
        return h + self.dropout(self.mlp(self.norm(h)))


class Stack(nn.Module):
    """Blocks on features with sine position embeddings; subclasses put layers before and after the blocks.

    Args:
        width: d, the width of the features.
        depth: number of blocks.
        heads: number of attention heads, a divisor of d.
        dropout: dropout rate in the blocks, while training.
    """

    def __init__(self, width: int, depth: int, heads: int, dropout: float):
        super().__init__()
        self.blocks = nn.Sequential(*(AttentionBlock(width, heads, dropout) for _ in range(depth)))
        self.norm, self.head = nn.LayerNorm(width), nn.Linear(width, width, bias=False)

    def prepare(self, h: Tensor) -> Tensor:
        """Map features (B, T, d) to the blocks' input; by default unchanged."""
        return h

    def finish(self, h: Tensor) -> Tensor:
        """Map the blocks' output (B, T, d) to features (B, T', d); by default unchanged."""
        return h

    def forward(self, h: Tensor) -> Tensor:
        """Map features (B, T, d) to features (B, T', d)."""
        h = self.prepare(h)
        return self.head(self.norm(self.finish(self.blocks(h + make_position_embeddings(h)))))


def make_position_embeddings(h: Tensor) -> Tensor:
    """Return position embeddings (T, d) for features (B, T, d), d even (Vaswani et al. 2017, Sec. 3.5).

    They are sines and cosines.
    """
    count, width = h.shape[-2:]
    rates = torch.exp(torch.arange(0, width, 2, device=h.device) * (-math.log(10_000) / width))
    angles = torch.arange(count, device=h.device)[:, None] * rates
    return torch.stack([angles.sin(), angles.cos()], -1).flatten(-2).to(h)


class ShorteningStack(Stack):
    """A convolution over time and a maximum over every two frames (T to T // 2), then blocks."""

    def __init__(self, width: int, depth: int, heads: int, dropout: float):
        super().__init__(width, depth, heads, dropout)
        self.convolution = nn.Conv1d(width, width, 3, padding=1)

    def prepare(self, h: Tensor) -> Tensor:
        return F.max_pool1d(self.convolution(h.transpose(1, 2)), 2).transpose(1, 2)


class LengtheningStack(Stack):
    """Blocks, then a transposed convolution over time that doubles the frames (T to 2T)."""

    def __init__(self, width: int, depth: int, heads: int, dropout: float):
        super().__init__(width, depth, heads, dropout)
        self.convolution = nn.ConvTranspose1d(width, width, 3, stride=2)

    def finish(self, h: Tensor) -> Tensor:
        return self.convolution(h.transpose(1, 2))[..., 1:].transpose(1, 2)

    def predict_last(self, h: Tensor, at: Tensor) -> Tensor:
        """Map features and their position embeddings (T, d) to only the last of 2 T frames (1, d)."""
        *earlier, block = self.blocks
        h = h + at
        for one in earlier:
            h = one(h)
        newest = cast(AttentionBlock, block).compute_newest(h, 1)
        newest = F.linear(newest, self.convolution.weight[..., -1].T, self.convolution.bias)
        return self.head(self.norm(newest))


class ProductQuantiser(nn.Module):
    """Eight codebooks of 64 vectors of 48, one for each part of a latent, learned by gradient.

    While training, rarely used code-vectors move towards the nearest latents; see `move_unused_codes`.
    """

    usage: Tensor
    needs_whole_batch = True  # several processes would each count and move codes by themselves

    def __init__(self) -> None:
        super().__init__()
        self.vectors = nn.Parameter(
            torch.empty(BOOKS, CODES, LATENT // BOOKS).uniform_(-1 / CODES, 1 / CODES)
        )
        self.register_buffer("usage", torch.zeros(BOOKS, CODES))

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return the quantised latents (..., 384), with straight-through gradients, and their loss.

        Distances to the code-vectors are in float32, also in mixed-precision training.
        """
        with use_float32(z.device):
            z = z.to(self.vectors.dtype)
            parts = z.flatten(0, -2).unflatten(-1, (BOOKS, -1)).transpose(0, 1)
            distance = torch.cdist(parts, self.vectors).square()
            index = distance.argmin(-1)
            codes = torch.stack([book[chosen] for book, chosen in zip(self.vectors, index, strict=True)], 1)
            codes = codes.flatten(-2).view_as(z)
            loss = (codes.detach() - z).square().mean() + (codes - z.detach()).square().mean()
            if self.training:
                self.move_unused_codes(parts.detach(), distance.detach(), index)
                loss = loss + sum(compute_contrast(one) for one in distance[:CONTRASTED])
            return z + (codes - z).detach(), loss

    @torch.no_grad()
    def move_unused_codes(self, parts: Tensor, distance: Tensor, index: Tensor) -> None:
        """Move code-vectors towards their nearest latents; rarely used code-vectors move furthest.

        Args:
            parts: the latents' parts (8, N, 48).
            distance: squared distances (8, N, 64) between parts and code-vectors.
            index: index of the code-vector nearest to each part (8, N).
        """
        share = F.one_hot(index, CODES).to(parts).mean(1)
        self.usage.lerp_(share, 1 - DECAY)
        weight = torch.exp(-self.usage * (BOOKS * CODES * 10) / (1 - DECAY) - 1e-3)[..., None]
        nearest = parts.gather(1, distance.argmin(1)[..., None].expand(-1, -1, parts.shape[-1]))
        # not in place: the losses' gradients are those of before
        self.vectors.data = self.vectors.data.lerp(nearest, weight)


def compute_contrast(distance: Tensor) -> Tensor:
    """Return a codebook's contrastive loss: nearest latents of each code-vector against the farther half.

    Args:
        distance: squared distances (N, 64) between latents and code-vectors.
    """
    near = -distance.sort(0, descending=True).values  # the last are the nearest
    positive = near[-max(1, len(near) // (BOOKS * CODES)) :].mean(0, keepdim=True)
    scores = torch.cat([positive, near[: len(near) // 2]]).T / TEMPERATURE
    return F.cross_entropy(scores, torch.zeros(CODES, dtype=torch.long, device=scores.device))


class HalfVQVAE(nn.Module):
    """The VQ-VAE of one half of the body: 7,239,436 parameters for the upper half, 7,200,986 for the lower.

    Args:
        joints: the joints of the half.
        settings: the network's settings; only `code_*` and `dropout` are used.
    """

    def __init__(self, joints: tuple[int, ...], settings: Any):
        super().__init__()
        width = settings.code_width
        blocks = width, settings.code_depth, settings.code_heads, settings.dropout
        self.joints, count = joints, len(joints)
        self.mixture = Mixture(count)
        self.stem = nn.Linear(count * (6 + JOINT_DIM), width)
        self.encoder = ShorteningStack(*blocks)
        self.into, self.out_of = nn.Linear(width, LATENT), nn.Linear(LATENT, width)
        self.quantiser = ProductQuantiser()
        self.decoder = LengtheningStack(*blocks)
        self.head = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, count * 6))

    def encode(self, rotation: Tensor, encoded: Tensor) -> tuple[Tensor, Tensor]:
        """Return quantised latents (B, T // 2, 384) and their loss.

        Args:
            rotation: rotations (B, T, 132) of all joints; only this half's joints are used.
            encoded: inputs (B, T, 54).
        """
        half = rotation.unflatten(-1, (N_JOINTS, 6))[..., list(self.joints), :]
        h = self.stem(torch.cat([half, self.mixture(encoded)], -1).flatten(-2))
        return self.quantiser(self.into(self.encoder(h)))

    def decode(self, latent: Tensor) -> Tensor:
        """Map latents (B, T // 2, 384) to the half's rotations (B, T, 6 J)."""
        return self.head(self.decoder(self.out_of(latent)))


class HalfRateEncoder(nn.Module):
    """Maps a window's inputs to features of T // 2 frames, by mixing over joints, then over time.

    Args:
        frames: T, the window's length.
        width: d, the width of the features.
    """

    def __init__(self, frames: int, width: int):
        super().__init__()
        self.mixture = Mixture(N_JOINTS)
        self.linear = nn.Linear(N_JOINTS * JOINT_DIM, width)
        self.time = nn.Linear(frames, frames // 2)

    def forward(self, encoded: Tensor, hidden: Tensor | None = None) -> Tensor:
        """Map inputs (B, T, 54) to features (B, T // 2, d).

        Args:
            encoded: inputs (B, T, 54).
            hidden: mask (B, 22) of hidden joints in training; None without hidden joints.
        """
        mixed = self.mixture(encoded)
        if hidden is not None:
            mixed = mixed.masked_fill(hidden[:, None, :, None], HIDDEN)
        return self.shorten(self.linear(mixed.flatten(-2)))

    def shorten(self, h: Tensor) -> Tensor:
        """Mix features (..., T, d) over time to (..., T // 2, d)."""
        return self.time(h.transpose(-1, -2)).transpose(-1, -2)


class UpperDenoiser(nn.Module):
    """Predicts the upper half's clean latents from noisy ones and the inputs; 57,969,432 parameters.

    Args:
        settings: the network's settings: frames, width, depth and heads.
    """

    def __init__(self, settings: Any):
        super().__init__()
        frames, width = settings.frames, settings.width
        self.condition = HalfRateEncoder(frames, width)
        self.time = TimeEmbedding(width, SINES)
        self.align = nn.Linear(frames // 2, frames // 2)
        self.stem = nn.Linear(width + LATENT, width)
        self.blocks = nn.ModuleList(DiTBlock(width, settings.heads, 4) for _ in range(settings.depth))
        self.head = nn.Linear(width, LATENT)

    def mix_frames(self, latent: Tensor) -> Tensor:
        """Mix the frames of latents (B, T // 2, 384)."""
        return self.align(latent.transpose(-1, -2)).transpose(-1, -2)

    def forward(self, noisy: Tensor, time: Tensor, encoded: Tensor, hidden: Tensor | None = None) -> Tensor:
        """Map noisy latents (B, T // 2, 384), times (B,) and inputs (B, T, 54) to clean latents.

        In training, `hidden` is a mask (B, 22) of hidden joints; see HalfRateEncoder.
        """
        return self.denoise(noisy, time, self.condition(encoded, hidden))

    def denoise(self, noisy: Tensor, time: Tensor, condition: Tensor) -> Tensor:
        """Map noisy latents (B, T // 2, 384), times (B,) and a condition (B, T // 2, d) to clean latents."""
        h = self.stem(torch.cat([condition, self.mix_frames(noisy)], -1))
        embedding = F.silu(self.time(time))
        for block in self.blocks:
            h = block(h, embedding)
        return self.head(h)


class LowerDenoiser(UpperDenoiser):
    """Predicts the lower half's clean latents, also from the upper half's latents; 58,264,728 parameters."""

    def __init__(self, settings: Any):
        super().__init__(settings)
        self.beside = nn.Linear(2 * LATENT, LATENT)

    def merge_latents(self, noisy: Tensor, upper: Tensor) -> Tensor:
        """Merge noisy latents and the upper half's latents (..., 384) into one tensor (..., 384)."""
        return self.beside(torch.cat([upper, noisy], -1))


class Decoder(nn.Module):
    """Computes rotations from both halves' latents and the inputs; 4,035,374 parameters.

    Args:
        settings: the network's settings; only `frames`, `code_*` and `dropout` are used.
    """

    def __init__(self, settings: Any):
        super().__init__()
        width = settings.code_width
        self.condition = HalfRateEncoder(settings.frames, LATENT)
        self.stem = nn.Linear(3 * LATENT, width)
        self.stack = LengtheningStack(width, settings.code_depth, settings.code_heads, settings.dropout)
        sizes = 6, ROTATION.stop - 6
        self.heads = nn.ModuleList(
            nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, size)) for size in sizes
        )

    def forward(self, upper: Tensor, lower: Tensor, encoded: Tensor) -> Tensor:
        """Map latents of both halves (B, T // 2, 384) and inputs (B, T, 54) to rotations (B, T, 132)."""
        h = self.stack(self.stem(torch.cat([self.condition(encoded), upper, lower], -1)))
        return torch.cat([head(h) for head in self.heads], -1)
