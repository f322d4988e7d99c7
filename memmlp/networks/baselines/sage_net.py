"""SAGE-Net (Feng et al., CVPR 2024): diffusion makes latents of the body's halves, a decoder makes the pose.

Its parts are trained one after the other (memmlp.training.train_sage), and then together.
"""

from __future__ import annotations

import torch
from torch import Tensor

from memmlp.motion.normalizer import Normalizer
from memmlp.networks.baselines.avatar_poser import OwnWindows
from memmlp.networks.baselines.diffusion import Diffusion
from memmlp.networks.baselines.sage_parts import LATENT, Decoder, HalfVQVAE, LowerDenoiser, UpperDenoiser
from memmlp.networks.memory import State
from memmlp.networks.motion_model import TrainingOutputs


class SAGENet(OwnWindows):
    """Samples the upper half's latents, then the lower half's given these, and decodes both to a pose.

    It has 120,269,534 parameters at the paper's sizes (120.27 M in Table 16); the VQ-VAEs that make the
    latents it learns from are not part of it. Every frame is the last one of its own window, and only that
    frame has losses.

    The noise that sampling starts from is always the same, drawn from `noise_seed`, as AGRoLDiffusion's is.

    Args:
        normalizer: converts between the world and network space.
        frames: T, the window's length.
        width: d, the width of the denoisers' features.
        depth: number of the denoisers' blocks.
        heads: number of the denoisers' attention heads; it divides d.
        code_width: the width of the decoder's and the VQ-VAEs' features, even.
        code_depth: number of blocks of the decoder, and of each VQ-VAE's encoder and decoder.
        code_heads: number of attention heads of the decoder and the VQ-VAEs; it divides `code_width`.
        dropout: dropout rate in the blocks of the decoder and the VQ-VAEs, while training.
        diffusion_steps: number of steps of the training's noise schedule.
        sampling_steps: number of calls of each denoiser at inference.
        noise: standard deviation of the noise that sampling starts from.
        noise_seed: the seed of that noise.
    """

    noises: Tensor

    def __init__(
        self,
        normalizer: Normalizer,
        *,
        frames: int,
        width: int,
        depth: int,
        heads: int,
        code_width: int,
        code_depth: int,
        code_heads: int,
        dropout: float,
        diffusion_steps: int,
        sampling_steps: int,
        noise: float,
        noise_seed: int,
    ):
        super().__init__(normalizer, frames)
        self._codes = {"width": code_width, "depth": code_depth, "heads": code_heads}
        self._dropout = dropout
        self.diffusion = Diffusion(diffusion_steps, sampling_steps)
        self.upper = UpperDenoiser(frames, width=width, depth=depth, heads=heads)
        self.lower = LowerDenoiser(frames, width=width, depth=depth, heads=heads)
        self.decoder = Decoder(frames, **self._codes, dropout=dropout)
        draw = torch.Generator().manual_seed(noise_seed)
        self.register_buffer("noises", noise * torch.randn(2, frames // 2, LATENT, generator=draw))

    def codes(self, joints: tuple[int, ...]) -> HalfVQVAE:
        """Make a VQ-VAE with fresh weights for the half of the body that has the given joints."""
        return HalfVQVAE(joints, **self._codes, dropout=self._dropout)

    def upper_latent(self, encoded: Tensor) -> Tensor:
        """Sample the upper half's latents (B, T // 2, 384) for inputs (B, T, 54)."""
        condition = self.upper.condition(encoded)
        return self.diffusion.sample(
            lambda noisy, time: self.upper.denoise(noisy, time, condition),
            self.noises[0].expand(len(encoded), -1, -1),
        )

    def lower_latent(self, upper: Tensor, encoded: Tensor) -> Tensor:
        """Sample the lower half's latents for inputs (B, T, 54), given the upper half's (B, T // 2, 384)."""
        condition = self.lower.condition(encoded)
        return self.diffusion.sample(
            lambda noisy, time: self.lower.denoise(self.lower.joined(noisy, upper), time, condition),
            self.noises[1].expand(len(encoded), -1, -1),
        )

    def rotations(self, encoded: Tensor) -> Tensor:
        """Map windows (B, T, 54) to their last frames' rotations (B, 132), both in network space."""
        upper = self.upper_latent(encoded)
        return self.decoder(upper, self.lower_latent(upper, encoded), encoded)[:, -1]

    def training_call(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Make a training call through both samplers, for the newest frame alone; see MotionModel."""
        return TrainingOutputs(*self.advance(sparse, state, 1), {})
