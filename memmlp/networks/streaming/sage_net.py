"""SAGE-Net's streaming graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.motion.body import SPARSE_DIM
from memmlp.networks.baselines.bodiffusion import DiTBlock
from memmlp.networks.baselines.sage_net import SAGENet
from memmlp.networks.baselines.sage_parts import LATENT, UpperDenoiser, places
from memmlp.networks.memory import State
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.streaming.bodiffusion import linear
from memmlp.networks.streaming.graph import StreamingGraph, slid


class SAGENetGraph(StreamingGraph):
    """SAGE-Net's streaming graph, which carries what each of the three parts computes from single frames.

    What the blocks compute from the diffusion times is the same at every step of a stream, so it is computed
    once. The decoder makes the newest frame alone.
    """

    float32_modules: tuple[str, ...] = ("sparse", "decoder.heads")
    places: Tensor

    def build(self, model: MotionModel) -> None:
        """Make the graph's parts from a copy of the network."""
        assert isinstance(model, SAGENet)
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
        seen = slid(state["seen"], entering, entering, fresh)
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
                noisy = self.diffusion.stepped(noisy, clean, index)
        return clean


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
