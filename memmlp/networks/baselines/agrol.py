"""AGRoL (Du et al., CVPR 2023): the MLP, and the diffusion model whose denoiser is that MLP.

Both take a window of inputs and make the rotations of all its frames; live, the last frame is kept. Their
papers' sizes are T = 196, d = 512 and 12 blocks, each the pre-norm pair of `memmlp.networks.layers.MLPBlock`.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.baselines.diffusion import Diffusion
from memmlp.networks.layers import MLPBlock
from memmlp.networks.memory import State
from memmlp.networks.window_model import WindowModel


class AGRoL(WindowModel):
    """A network that makes the rotations of a whole window from its inputs (`rotations`)."""

    def rotations(self, encoded: Tensor) -> Tensor:
        """Inputs (B, T, 54) -> rotations (B, T, 132), both in network space."""
        raise NotImplementedError

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """See WindowModel; all T frames by default. The work is that of the whole window, as published."""
        inputs, kept = self.taken_in(sparse, state)
        window = inputs[:, -self.frames :]
        rotation = self.rotations(self.normalizer.encode_sparse(window, self.normalizer.origin(window)))
        wanted = self.frames if newest is None else newest
        return self.normalizer.posed(rotation[:, -wanted:], window[:, -wanted:]), kept


class AGRoLMLP(AGRoL):
    """Stem, MLP blocks, head: 3,735,668 parameters at the paper's sizes, 3.74 M in Table 16.

    Args:
        normalizer: world <-> network space.
        frames: T. width: d. depth: blocks.
    """

    def __init__(self, normalizer: Normalizer, *, frames: int, width: int, depth: int):
        super().__init__(normalizer, frames)
        self.stem = nn.Linear(SPARSE_DIM, width)
        self.blocks = nn.ModuleList(MLPBlock(width, frames) for _ in range(depth))
        self.head = nn.Linear(width, ROTATION.stop)

    def rotations(self, encoded: Tensor) -> Tensor:
        """Inputs (B, T, 54) -> rotations (B, T, 132), both in network space."""
        h = self.stem(encoded)
        for block in self.blocks:
            h = block(h)
        return self.head(h)


class TimedBlock(MLPBlock):
    """An MLP block whose input is shifted by a projection of the diffusion time's embedding."""

    def __init__(self, width: int, frames: int):
        super().__init__(width, frames)
        self.time = nn.Linear(width, width)

    def forward(self, h: Tensor, past: object = None) -> Tensor:
        """Hidden state (B, T, d) and embedding (B, d) in the place of the past -> (B, T, d)."""
        assert isinstance(past, Tensor)
        return super().forward(h + self.time(F.silu(past))[:, None])


class TimeEmbedding(nn.Module):
    """Sines and cosines of the diffusion time, then Linear, SiLU, Linear (Ho et al. 2020)."""

    PERIOD = 10_000

    rates: Tensor

    def __init__(self, width: int):
        super().__init__()
        rates = torch.exp(-math.log(self.PERIOD) * torch.arange(width // 2) / (width // 2))
        self.register_buffer("rates", rates, persistent=False)
        self.mlp = nn.Sequential(nn.Linear(2 * len(rates), width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, time: Tensor) -> Tensor:
        """Times (B,) -> (B, d)."""
        angles = time[:, None] * self.rates
        return self.mlp(torch.cat([angles.cos(), angles.sin()], -1))


class AGRoLDiffusion(AGRoL):
    """A denoiser of rotations conditioned on the window's inputs; it predicts the clean ones.

    7,480,436 parameters at the paper's sizes, 7.48 M in Table 16: the MLP's blocks and head (3,707,508), a
    linear of each block for the time's embedding (12 x 262,656), the embedding's own two (525,312), and a
    stem for noisy motion and inputs side by side (95,744). The paper says that the embedding enters every
    block; that it does so by these layers, added to the block's input, is what its count leaves (reading).

    A window's noise is always the same, drawn from `noise_seed`: sampling is a function of the inputs, in
    torch as in ONNX, and consecutive windows of a stream do not differ by their noise.

    Args:
        normalizer: world <-> network space.
        frames: T. width: d. depth: blocks.
        diffusion_steps: of the training's noise schedule. sampling_steps: denoiser calls at inference.
        noise_seed: of the noise that sampling starts from.
    """

    noise: Tensor

    def __init__(
        self,
        normalizer: Normalizer,
        *,
        frames: int,
        width: int,
        depth: int,
        diffusion_steps: int,
        sampling_steps: int,
        noise_seed: int,
    ):
        super().__init__(normalizer, frames)
        self.diffusion = Diffusion(diffusion_steps, sampling_steps)
        self.time = TimeEmbedding(width)
        self.stem = nn.Linear(ROTATION.stop + SPARSE_DIM, width)
        self.blocks = nn.ModuleList(TimedBlock(width, frames) for _ in range(depth))
        self.head = nn.Linear(width, ROTATION.stop)
        draw = torch.Generator().manual_seed(noise_seed)
        self.register_buffer("noise", torch.randn(frames, ROTATION.stop, generator=draw))

    def denoise(self, noisy: Tensor, time: Tensor, encoded: Tensor) -> Tensor:
        """Noisy rotations (B, T, 132) at times (B,), inputs (B, T, 54) -> clean rotations (B, T, 132)."""
        embedding = self.time(time)
        h = self.stem(torch.cat([noisy, encoded], -1))
        for block in self.blocks:
            h = block(h, embedding)
        return self.head(h)

    def rotations(self, encoded: Tensor) -> Tensor:
        """Sampled rotations (B, T, 132) for inputs (B, T, 54), both in network space."""
        noise = self.noise.expand(len(encoded), -1, -1)
        return self.diffusion.sample(lambda noisy, time: self.denoise(noisy, time, encoded), noise)

    def learn(self, sparse: Tensor, state: State, truth: Tensor) -> tuple[Tensor, State]:
        """One denoiser call on the truth (B, T, 252) with noise of a time drawn for each window."""
        _, kept = self.taken_in(sparse, state)
        window, frames = truth[..., :SPARSE_DIM], self.normalizer.encode(truth)
        encoded, clean = frames[..., :SPARSE_DIM], frames[..., SPARSE_DIM:][..., ROTATION]
        time = torch.randint(self.diffusion.steps, (len(truth),), device=truth.device)
        noisy = self.diffusion.noised(clean, time, torch.randn_like(clean))
        return self.normalizer.posed(self.denoise(noisy, time, encoded), window), kept
