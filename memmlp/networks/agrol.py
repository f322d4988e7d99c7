"""AGRoL (Du et al., CVPR 2023): the MLP, and the diffusion model whose denoiser is that MLP.

Both predict the rotations of all frames of a window from its inputs. A live stream keeps the last frame. The
paper's sizes are T = 196, d = 512 and 12 blocks, each the pre-norm pair of `memmlp.networks.layers.MLPBlock`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.settings import at_least, one_of, setting, tuned
from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.diffusion import Diffusion, PosteriorDiffusion
from memmlp.networks.layers import MLPBlock
from memmlp.networks.motion_model import State, TrainingOutputs, WindowModel
from memmlp.networks.settings import NetworkSettings, Release, make_strided_times
from memmlp.networks.streaming import StemGraph, make_linear

BLOCK_NAMES = {
    "blocks.*.time_norm.*": "motion_mlp.mlps.*.norm0.*",
    "blocks.*.time_mix.*": "motion_mlp.mlps.*.fc0.*",
    "blocks.*.norm.*": "motion_mlp.mlps.*.norm1.*",
    "blocks.*.linear.*": "motion_mlp.mlps.*.fc1.*",
}
"""The names of the blocks' parts in the released code, for a Release."""


class AGRoLMLPGraph(StemGraph):
    """The streaming graph of AGRoL's MLP."""

    model: AGRoLMLP
    blocks: list[MLPBlock]

    def build(self, model: Any) -> None:
        self.model, self.width = model, model.stem.out_features
        self.blocks = cast(list[MLPBlock], list(model.blocks))

    def embed_frame(self, encoded: Tensor) -> Tensor:
        return self.model.stem(encoded)

    def predict_rotation(self, window: Tensor, encoded: Tensor) -> Tensor:
        """Apply blocks and head to (T, d); the last block computes only the newest frame (1, 132)."""
        *earlier, last = self.blocks
        for block in earlier:
            window = block(window)
        return self.model.head(last.compute_newest(window, 1))


@component("model", "agrol_mlp", builds="AGRoLMLP")
@dataclass
class AGRoLMLPSettings(NetworkSettings):
    """AGRoL's MLP (Du et al. 2023), which predicts whole windows; a stream keeps the last frame.

    Loss, depth and features follow its released code. The training settings differ: AdamW instead of Adam,
    final_lr 1e-5 instead of 3e-5, and the profile's values. profile=paper has the authors' batch size and
    learning rates.
    """

    frames: int = setting(at_least(2), tiny=11, small=196, paper=196)  # T, the number of frames in a window
    # d, the width of the hidden state
    width: int = setting(at_least(1), tiny=16, small=128, paper=512, width_fraction=1)
    depth: int = setting(at_least(1), 12)  # number of blocks

    defaults: ClassVar = {"loss": "agrol"}
    recipe: ClassVar = tuned(8.0e-3)
    release: ClassVar = Release(
        source="facebookresearch/AGRoL 13a2b63",
        names={"stem.*": "input_fc.*", **BLOCK_NAMES, "head.*": "output_fc.*"},
        sizes={
            "model.frames": ("motion_mlp.mlps.0.fc0.weight", 0),
            "model.width": ("input_fc.weight", 0),
            "model.depth": "motion_mlp.mlps.*.fc0.weight",
        },
    )


class AGRoLMLP(WindowModel):
    """AGRoL's MLP: stem, MLP blocks, head.

    It has 3,735,668 parameters at the paper's sizes (3.74 M in Table 16).
    """

    graph = AGRoLMLPGraph

    def __init__(self, normalizer: Normalizer, settings: AGRoLMLPSettings):
        super().__init__(normalizer, settings.frames)
        self.stem = nn.Linear(SPARSE_DIM, settings.width)
        self.blocks = nn.ModuleList(MLPBlock(settings.width, settings.frames) for _ in range(settings.depth))
        self.head = nn.Linear(settings.width, ROTATION.stop)

    def predict_rotations(self, encoded: Tensor) -> Tensor:
        h = self.stem(encoded)
        for block in self.blocks:
            h = block(h)
        return self.head(h)


class TimedBlock(MLPBlock):
    """An MLP block that adds a projection of the diffusion time's embedding to its input."""

    def __init__(self, width: int, frames: int):
        super().__init__(width, frames)
        self.time = nn.Linear(width, width)

    def forward(self, h: Tensor, past: object = None) -> Tensor:
        """Map the hidden state (B, T, d) to (B, T, d).

        Args:
            h: hidden state (B, T, d).
            past: the embedding (B, d) of the diffusion time; other blocks receive the past in this argument.
        """
        assert isinstance(past, Tensor)
        return super().forward(h + self.time(F.silu(past))[:, None])


class AGRoLDiffusionGraph(StemGraph):
    """The streaming graph of AGRoL's diffusion model.

    Each block's shift for the diffusion time is the same at every step of a stream, so it is computed once.
    """

    float32_modules = ("inputs", "noisy", "model.head")
    model: AGRoLDiffusion
    blocks: list[MLPBlock]
    shifts: Tensor

    def build(self, model: Any) -> None:
        self.model, self.width = model, model.merge.out_features
        self.blocks = cast(list[MLPBlock], list(model.blocks))
        of_inputs, of_motion = model.merge.weight.chunk(2, 1)
        bias = model.merge.bias + of_inputs @ model.sparse.bias + of_motion @ model.motion.bias
        self.inputs = make_linear(of_inputs @ model.sparse.weight, bias)
        self.noisy = make_linear(of_motion @ model.motion.weight)
        embedding = F.silu(model.embed_time(torch.tensor(model.diffusion.times)))
        timed = cast(list[TimedBlock], self.blocks)
        self.register_buffer("shifts", torch.stack([block.time(embedding) for block in timed], 1))

    def embed_frame(self, encoded: Tensor) -> Tensor:
        """Return the part of the merged input (1, d) that comes from a frame's inputs (1, 54).

        The part that comes from the noisy motion is added at each denoiser call.
        """
        return self.inputs(encoded)

    def predict_rotation(self, window: Tensor, encoded: Tensor) -> Tensor:
        """Draw a sample; the denoiser's last call computes only the newest frame (1, 132)."""
        first, *further = self.model.noise
        return self.model.diffusion.sample(partial(self._denoise, window), first, further)

    def _denoise(self, window: Tensor, noisy: Tensor, index: int) -> Tensor:
        count = 1 if index + 1 == self.model.diffusion.calls else self.frames
        h = window + self.noisy(noisy)
        *earlier, last = zip(self.blocks, self.shifts[index], strict=True)
        for block, shift in earlier:
            h = block.compute_newest(h + shift, self.frames)
        block, shift = last
        return self.model.head(block.compute_newest(h + shift, count))


@component("model", "agrol_diffusion", version=2, builds="AGRoLDiffusion")
@dataclass
class AGRoLDiffusionSettings(AGRoLMLPSettings):
    """AGRoL's diffusion model (Du et al. 2023), which generates a window's rotations from noise.

    Layers, loss, depth, noise schedule and features follow its released code, which normalises the motion but
    not the inputs. The training settings differ: AdamW instead of Adam, final_lr, and the profile's values.
    """

    # d, the width of the hidden state; must be even
    width: int = setting(at_least(2), tiny=16, small=128, paper=512, width_fraction=1)
    diffusion_steps: int = setting(at_least(1), 1000)  # number of steps in the cosine noise schedule
    sampling_steps: int = setting(at_least(1), 5)  # number of denoiser calls per window
    noise_seed: int = setting(at_least(0), 0)  # seed of the sampling noise, equal for all windows
    # ddim: no noise in the steps, as in the paper; posterior: with noise and at times 0, 200, ..., as in the
    # released code
    sampler: str = setting(one_of("ddim", "posterior"), "ddim")

    recipe: ClassVar = {"normalizer.z_scores": True, "normalizer.raw_inputs": True}
    release: ClassVar = Release(
        source="facebookresearch/AGRoL 13a2b63",
        names={
            "motion.*": "input_process.*",
            "sparse.*": "sparse_process.*",
            "merge.*": "mlp.motion_mlp.mlps.0.conct.*",
            **{ours: f"mlp.{theirs}" for ours, theirs in BLOCK_NAMES.items()},
            "blocks.*.time.*": "mlp.motion_mlp.mlps.*.emb_fc.*",
            "head.*": "output_process.*",
        },
        sizes={
            "model.frames": ("mlp.motion_mlp.mlps.0.fc0.weight", 0),
            "model.width": ("input_process.weight", 0),
            "model.depth": "mlp.motion_mlp.mlps.*.fc0.weight",
        },
        unused=("embed_timestep.pe",),
        config={"model.sampler": "posterior"},
    )

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        yield from super().problems(config)
        model = config["model"]
        if model["width"] % 2:
            yield f"model.width={model['width']}: must be even with model=agrol_diffusion"
        steps, calls = model["diffusion_steps"], model["sampling_steps"]
        if model["sampler"] == "posterior" and len(make_strided_times(steps, calls)) != calls:
            yield f"model.sampling_steps={calls}: must divide {steps} steps with model.sampler=posterior"


class AGRoLDiffusion(WindowModel):
    """A denoiser of rotations, conditioned on the window's inputs, that predicts the clean rotations.

    It has 7,480,436 parameters at the paper's sizes (7.48 M in Table 16): the MLP's blocks and head
    (3,707,508), a linear layer of each block for the time's embedding (12 x 262,656), a linear layer each for
    noisy motion (68,096) and inputs (28,160), and one that merges both (524,800).

    Sampling always starts from the same noise, drawn with `noise_seed`. Its result therefore depends only on
    the inputs, in torch and in ONNX, and consecutive windows of a stream share their noise.
    """

    graph = AGRoLDiffusionGraph
    noise: Tensor

    def __init__(self, normalizer: Normalizer, settings: AGRoLDiffusionSettings):
        super().__init__(normalizer, settings.frames)
        sampler = {"ddim": Diffusion, "posterior": PosteriorDiffusion}[settings.sampler]
        self.diffusion = sampler(settings.diffusion_steps, settings.sampling_steps)
        self.motion = nn.Linear(ROTATION.stop, settings.width)
        self.sparse = nn.Linear(SPARSE_DIM, settings.width)
        self.merge = nn.Linear(2 * settings.width, settings.width)
        self.blocks = nn.ModuleList(
            TimedBlock(settings.width, settings.frames) for _ in range(settings.depth)
        )
        self.head = nn.Linear(settings.width, ROTATION.stop)
        draw = torch.Generator().manual_seed(settings.noise_seed)
        shape = self.diffusion.noise_draws, settings.frames, ROTATION.stop
        self.register_buffer("noise", torch.randn(shape, generator=draw))

    def embed_time(self, time: Tensor) -> Tensor:
        """Return sines and cosines of diffusion times (n,), alternating (n, d) (Vaswani et al. 2017)."""
        width = self.merge.out_features
        rates = torch.exp(torch.arange(0, width, 2) * (-math.log(10_000) / width)).to(time.device)
        angles = time[:, None] * rates
        return torch.stack([angles.sin(), angles.cos()], -1).flatten(-2).to(self.noise.dtype)

    def denoise(self, noisy: Tensor, time: Tensor, encoded: Tensor) -> Tensor:
        """Predict the clean rotations (B, T, 132).

        Args:
            noisy: noisy rotations (B, T, 132).
            time: diffusion times (B,).
            encoded: inputs (B, T, 54) in network space.
        """
        embedding = self.embed_time(time)
        h = self.merge(torch.cat([self.sparse(encoded), self.motion(noisy)], -1))
        for block in self.blocks:
            h = block(h, embedding)
        return self.head(h)

    def predict_rotations(self, encoded: Tensor) -> Tensor:
        first, *further = self.noise
        return self.diffusion.sample(
            lambda noisy, index: self.denoise(noisy, self.diffusion.find_times(index, noisy), encoded),
            first.expand(len(encoded), -1, -1),
            further,
        )

    def compute_training_outputs(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Add noise to the truth, and denoise it in one denoiser call; see MotionModel.

        A diffusion time is drawn for each window.
        """
        _, kept = self.append_inputs(sparse, state)
        window, frames = true_frames[..., :SPARSE_DIM], self.normalizer.encode(true_frames)
        encoded, clean = frames[..., :SPARSE_DIM], frames[..., SPARSE_DIM:][..., ROTATION]
        noisy, time, _ = self.diffusion.draw_noisy(clean)
        return TrainingOutputs(
            self.normalizer.decode_rotations(self.denoise(noisy, time, encoded), window), kept, {}
        )
