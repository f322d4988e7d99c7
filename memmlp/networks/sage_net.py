"""SAGE-Net (Feng et al., CVPR 2024): diffusion makes latents of the body's halves, a decoder makes the pose.

Its parts are trained one after the other (memmlp.training.train_sage), and then together.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.diffusion import Diffusion
from memmlp.networks.motion_model import OwnWindows, State, StreamingGraph, TrainingOutputs, slide_window
from memmlp.networks.sage_parts import LATENT, Decoder, HalfVQVAE, LowerDenoiser, UpperDenoiser, places
from memmlp.networks.streaming import linear
from memmlp.networks.transformer import DiTBlock


class DenoiserAtSamplingTimes(nn.Module):
    """A denoiser restricted to the diffusion times at which samples are made.

    Args:
        denoiser: the denoiser.
        times: the diffusion times.
    """

    modulations: Tensor

    def __init__(self, denoiser: UpperDenoiser, times: list[int]):
        super().__init__()
        weight = denoiser.stem.weight
        embedding = F.silu(denoiser.time(torch.tensor(times).to(weight)))
        self.blocks = cast(list[DiTBlock], denoiser.blocks)
        made = torch.stack([block.modulation(embedding) for block in self.blocks], 1)
        self.register_buffer("modulations", made)
        seen, noisy = weight.split([weight.shape[1] - LATENT, LATENT], 1)
        self.denoiser, self.seen, self.noisy = denoiser, linear(seen, denoiser.stem.bias), linear(noisy)

    def condition(self, seen: Tensor) -> Tensor:
        """Return the condition (T // 2, d) that the stem makes from the window's inputs as carried (T, d)."""
        return self.seen(self.denoiser.condition.shortened(seen))

    def forward(self, noisy: Tensor, condition: Tensor, index: int) -> Tensor:
        """Map noisy latents (T // 2, 384) at sampling step `index` to clean ones."""
        h = condition + self.noisy(self.denoiser.aligned(noisy))
        for block, modulation in zip(self.blocks, self.modulations[index], strict=True):
            h = block.newest(h, modulation.chunk(6), h.shape[-2])
        return self.denoiser.head(h)


class SAGENetGraph(StreamingGraph):
    """SAGE-Net's streaming graph, which carries what each of the three parts computes from single frames.

    What the blocks compute from the diffusion times is the same at every step of a stream, so it is computed
    once. The decoder makes the newest frame alone.
    """

    float32_modules: tuple[str, ...] = ("sparse", "decoder.heads")
    places: Tensor

    def build(self, model: Any) -> None:
        """Make the graph's parts from a copy of the network."""
        self.diffusion, self.noises, self.decoder = model.diffusion, model.noises, model.decoder
        self.upper, self.lower = (
            DenoiserAtSamplingTimes(part, model.diffusion.times) for part in (model.upper, model.lower)
        )
        self.beside = model.lower.beside
        conditions = model.upper.condition, model.lower.condition, model.decoder.condition
        self.widths = [one.linear.out_features for one in conditions]

        def entering(encoded: Tensor) -> Tensor:
            return torch.cat([one.linear(one.mixture(encoded).flatten(-2)) for one in conditions], -1)

        nothing = torch.zeros(1, SPARSE_DIM).to(model.noises)
        offset = entering(nothing)
        self.sparse = linear((entering(torch.eye(SPARSE_DIM).to(nothing)) - offset).T, offset[0])
        self.register_buffer(
            "places", places(nothing.new_zeros(self.frames // 2, model.decoder.stem.out_features))
        )

    def windows(self) -> State:
        """Return zeros (T, d + d + 384): what the denoisers and the decoder compute from each frame alone."""
        return {"seen": torch.zeros(self.frames, sum(self.widths))}

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and the new state."""
        encoded = self.normalizer.encode_sparse(sparse, self.normalizer.origin(sparse))
        entering = self.sparse(encoded)
        seen = slide_window(state["seen"], entering, entering, fresh)
        rotation = self.decoded(*seen.split(self.widths, -1))
        return self.normalizer.posed(rotation, sparse), {"seen": seen}

    def decoded(self, for_upper: Tensor, for_lower: Tensor, for_decoder: Tensor) -> Tensor:
        """Return the newest frame's rotations (1, 132), from what each part has of the window (T, ...)."""
        upper = self.sampled(self.upper, for_upper, self.noises[0], lambda noisy: noisy)
        lower = self.sampled(
            self.lower, for_lower, self.noises[1], lambda noisy: self.beside(torch.cat([upper, noisy], -1))
        )
        shortened = self.decoder.condition.shortened(for_decoder)
        h = self.decoder.stem(torch.cat([shortened, upper, lower], -1))
        newest = self.decoder.stack.last(h, self.places)
        return torch.cat([head(newest) for head in self.decoder.heads], -1)

    def sampled(
        self,
        sampler: DenoiserAtSamplingTimes,
        seen: Tensor,
        noise: Tensor,
        joined: Callable[[Tensor], Tensor],
    ) -> Tensor:
        """Sample latents (T // 2, 384) from noise, given what the denoiser has of the window (T, d)."""
        condition, noisy = sampler.condition(seen), noise
        for index in range(len(self.diffusion.times)):
            clean = sampler(joined(noisy), condition, index)
            if index + 1 < len(self.diffusion.times):
                noisy = self.diffusion.step(noisy, clean, index)
        return clean


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

    graph = SAGENetGraph
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
