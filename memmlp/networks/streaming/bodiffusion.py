"""BoDiffusion's streaming graph."""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.motion.body import N_JOINTS, ROTATION, SPARSE_DIM
from memmlp.networks.baselines.ancestral_diffusion import Denoised
from memmlp.networks.baselines.bodiffusion import NOISY, BoDiffusion, DiTBlock
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.streaming.baselines import AGRoLGraph


class BoDiffusionGraph(AGRoLGraph):
    """BoDiffusion's streaming graph, in which successive layers without a non-linearity between are merged.

    The stem's output for each frame's inputs is carried, in order of time. What the blocks compute from the
    diffusion times is the same at every step of a stream, so it is computed once. The last denoiser call
    makes the newest frame alone.
    """

    float32_modules = ("sparse", "motion", "made")
    model: BoDiffusion
    blocks: list[DiTBlock]
    modulations: Tensor

    def build(self, model: MotionModel) -> None:
        """Make the graph's parts from a copy of the network."""
        assert isinstance(model, BoDiffusion)
        self.model, self.width = model, model.stem.out_features
        self.blocks = cast(list[DiTBlock], list(model.blocks))
        embedding = F.silu(model.time(torch.tensor(model.diffusion.times).to(model.noises)))
        self.register_buffer(
            "modulations", torch.stack([block.modulation(embedding) for block in self.blocks], 1)
        )
        motion, sparse = model.stem.weight.unflatten(-1, (N_JOINTS, -1)).tensor_split([NOISY], -1)
        self.motion = linear(motion.flatten(1))
        mixture = model.mixed(torch.eye(SPARSE_DIM).to(sparse)).flatten(1)
        self.sparse = linear(sparse.flatten(1) @ mixture.T, model.stem.bias)
        head = model.head.weight.unflatten(0, (N_JOINTS, -1)).transpose(0, 1).flatten(1)
        offset = model.head.bias.unflatten(0, (N_JOINTS, -1))
        made = (model.joint_head.weight @ head).unflatten(1, (N_JOINTS, -1)).unflatten(0, (2, NOISY))
        bias = model.joint_head(offset).unflatten(1, (2, NOISY))
        self.made = linear(made.transpose(1, 2).flatten(0, 2), bias.transpose(0, 1).flatten())

    def entering(self, encoded: Tensor) -> Tensor:
        """Return the part of the stem's output (1, d) that comes from a frame's inputs (1, 54).

        The part that comes from the noisy motion is added at each denoiser call.
        """
        return self.sparse(encoded)

    def rotation(self, window: Tensor) -> Tensor:
        """Sample step by step; the last step makes the newest frame (1, 132) alone."""
        diffusion, limits = self.model.diffusion, self.model.limits()
        last = len(diffusion.times) - 1

        def step(noisy: Tensor, index: int) -> tuple[Tensor, Tensor]:
            count = 1 if index == last else self.frames
            made = self._made(noisy, window, index, count)
            mean, variance = diffusion.step(noisy[-count:], made, index, limits)
            return mean, variance.sqrt()

        return diffusion.sample(step, self.model.noises)

    def _made(self, noisy: Tensor, window: Tensor, index: int, count: int) -> Denoised:
        """Predict noise and variance of the newest `count` frames of (T, 132) at sampling step `index`."""
        h = window + self.motion(noisy) + self.model.places
        *earlier, last = zip(self.blocks, self.modulations[index], strict=True)
        for block, modulation in earlier:
            h = block.newest(h, modulation.chunk(6), self.frames)
        block, modulation = last
        return Denoised(*self.made(block.newest(h, modulation.chunk(6), count)).split(ROTATION.stop, -1))


def linear(weight: Tensor, bias: Tensor | None = None) -> nn.Linear:
    """Return the linear layer of a weight (m, n) and a bias (m,)."""
    layer = nn.Linear(weight.shape[1], weight.shape[0], bias is not None).to(weight)
    layer.weight = nn.Parameter(weight.contiguous())
    if bias is not None:
        layer.bias = nn.Parameter(bias)
    return layer
