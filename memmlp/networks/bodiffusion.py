"""BoDiffusion (Castillo et al., ICCV 2023): a transformer that denoises the rotations of a window.

The published network is offline. It denoises half-overlapping windows together, and averages them at every
step.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.settings import at_least, one_of, positive, setting, tuned
from memmlp.motion.body import N_JOINTS, ROTATION, SPARSE_DIM, TRACKED
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.diffusion import (
    AncestralDiffusion,
    DenoiserOutput,
    ReleasedAncestralDiffusion,
    TimeEmbedding,
)
from memmlp.networks.motion_model import State, TrainingOutputs, WindowModel
from memmlp.networks.settings import NetworkSettings, Release, name_dit_blocks
from memmlp.networks.streaming import StemGraph, make_linear
from memmlp.networks.transformer import DiTBlock

SINES = 256  # of the diffusion time
CHANNELS = SPARSE_DIM // len(TRACKED)  # of the inputs, of which each joint gets a mixture of thirds
NOISY = 6  # channels of the noisy motion, a joint's 6D rotation


class BoDiffusionGraph(StemGraph):
    """BoDiffusion's streaming graph, which merges successive linear layers.

    It carries the stem's output for each frame's inputs, oldest first. The blocks' modulations by the
    diffusion times are the same at every step of a stream, so they are computed once. The last denoiser call
    computes only the newest frame.
    """

    float32_modules = ("sparse", "motion", "output")
    model: BoDiffusion
    blocks: list[DiTBlock]
    modulations: Tensor

    def build(self, model: Any) -> None:
        self.model, self.width = model, model.stem.out_features
        self.blocks = cast(list[DiTBlock], list(model.blocks))
        embedding = F.silu(model.time(torch.tensor(model.diffusion.times).to(model.noises)))
        self.register_buffer(
            "modulations", torch.stack([block.modulation(embedding) for block in self.blocks], 1)
        )
        motion, sparse = model.stem.weight.unflatten(-1, (N_JOINTS, -1)).tensor_split([NOISY], -1)
        self.motion = make_linear(motion.flatten(1))
        mixture = model.mix_input_thirds(torch.eye(SPARSE_DIM).to(sparse)).flatten(1)
        self.sparse = make_linear(sparse.flatten(1) @ mixture.T, model.stem.bias)
        head = model.head.weight.unflatten(0, (N_JOINTS, -1)).transpose(0, 1).flatten(1)
        offset = model.head.bias.unflatten(0, (N_JOINTS, -1))
        weight = (model.joint_head.weight @ head).unflatten(1, (N_JOINTS, -1)).unflatten(0, (2, NOISY))
        bias = model.joint_head(offset).unflatten(1, (2, NOISY))
        self.output = make_linear(weight.transpose(1, 2).flatten(0, 2), bias.transpose(0, 1).flatten())

    def embed_frame(self, encoded: Tensor) -> Tensor:
        """Return the part of the stem's output (1, d) that comes from a frame's inputs (1, 54).

        The part that comes from the noisy motion is added at each denoiser call.
        """
        return self.sparse(encoded)

    def predict_rotation(self, window: Tensor, encoded: Tensor) -> Tensor:
        """Sample step by step; the last step computes only the newest frame (1, 132)."""
        diffusion, limits = self.model.diffusion, self.model.compute_limits()
        last = len(diffusion.times) - 1

        def step(noisy: Tensor, index: int) -> tuple[Tensor, Tensor]:
            count = 1 if index == last else self.frames
            h = window + self.motion(noisy) + self.model.places
            *earlier, (block, modulation) = zip(self.blocks, self.modulations[index], strict=True)
            for one, its in earlier:
                h = one.compute_newest(h, its.chunk(6), self.frames)
            outputs = self.output(block.compute_newest(h, modulation.chunk(6), count))
            outputs = DenoiserOutput(*outputs.split(ROTATION.stop, -1))
            mean, variance = diffusion.step(noisy[-count:], outputs, index, limits)
            return mean, variance.sqrt()

        return diffusion.sample(step, self.model.noises)


@component("model", "bodiffusion", version=2, builds="BoDiffusion")
@dataclass
class BoDiffusionSettings(NetworkSettings):
    """BoDiffusion (Castillo et al. 2023): a transformer that generates a window's rotations from noise.

    The published network needs model.offline=true evaluation.modes=[window] export.graph=off. It denoises a
    clip's overlapping windows together. Loss (noise, variational bound), noise schedule, features and
    averaged weights follow its released code. Its test takes 999 sampling steps by default. The training
    settings differ: AdamW with the profile's schedule, instead of 1e-5 without weight decay.
    """

    frames: int = setting(at_least(2), tiny=11, small=41, paper=41)  # T, the number of frames in a window
    # d, the width of the hidden state; a width below 132 cannot represent the noise of all rotations
    width: int = setting(at_least(2), tiny=16, small=192, paper=384)
    depth: int = setting(at_least(1), tiny=2, small=4, paper=12)  # number of blocks
    heads: int = setting(at_least(1), tiny=4, small=3, paper=6)  # number of attention heads
    diffusion_steps: int = setting(at_least(1), 1000)  # number of steps in the linear noise schedule
    sampling_steps: int = setting(at_least(1), tiny=2, small=10, paper=25)  # denoiser calls per window
    # ancestral: each call adds noise, except the last call and calls within the last 50 steps of the
    # schedule; released: times, noise and limits of the released code
    sampler: str = setting(one_of("ancestral", "released"), "ancestral")
    noise_seed: int = setting(at_least(0), 0)  # seed of the sampling noise, equal for all windows
    noise_weight: float = setting(at_least(0), 1.0)  # weight of the loss for the predicted noise
    # weight of the variational bound, which trains the variances
    bound_weight: float = setting(positive(), 1.0)
    offline: bool = setting(default=False)  # true: uses future frames, as published; cannot stream

    trains_by_itself: ClassVar[bool] = True
    defaults: ClassVar = {"loss": "of_network"}
    # profile.ema is the default of optim.ema: the averaged weights that its authors train
    recipe: ClassVar = {"profile.ema": 0.9999, **tuned(2.0e-3)}
    # with weights of 1 it did not learn the motion (docs/results/recurrent_poser.md)
    kinematic: ClassVar[str] = (
        f"{NetworkSettings.kinematic} model.noise_weight=1000.0 model.bound_weight=1000.0"
    )

    release: ClassVar = Release(
        source="BCV-Uniandes/BoDiffusion 0ffd1b8",
        names={
            "time.mlp.*.*": "embed_timestep.mlp.*.*",
            "spread.*": "cond_emb.projections.*",
            "stem.*": "input_process.poseEmbedding.*",
            "places": "pos_embed",
            **name_dit_blocks("blocks.*", "blocks.*"),
            "head.*": "out.poseFinal.*",
            "joint_head.*": "out.featsFinal.*",
        },
        sizes={
            "model.frames": ("pos_embed", 1),
            "model.width": ("pos_embed", 2),
            "model.depth": "blocks.*.attn.qkv.weight",
        },
        config={
            "model.offline": True,
            "evaluation.modes": ["window"],
            "export.graph": "off",
            "model.sampler": "released",
            "model.sampling_steps": 999,
        },
    )

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        yield from super().problems(config)
        if config["loss"]["name"] == "of_network" and not config["model"]["noise_weight"]:
            yield "model.noise_weight=0: must be above 0 with loss=of_network"
        calls, steps = config["model"]["sampling_steps"], config["model"]["diffusion_steps"]
        if config["model"]["sampler"] == "released" and not 1 < calls < steps:
            yield f"model.sampling_steps={calls}: must be from 2 to {steps - 1} with model.sampler=released"


class BoDiffusion(WindowModel):
    """BoDiffusion's denoiser, which predicts the noise in rotations from the window's inputs.

    It has 21,942,270 trained parameters at the paper's sizes (T = 41, d = 384, 12 blocks), and frame position
    embeddings that are zero and not trained, as in the released code.

    Sampling always uses the same noise, drawn with `noise_seed`, like AGRoLDiffusion. A live stream samples a
    window at each frame, and keeps the window's last frame.
    """

    graph = BoDiffusionGraph
    noises: Tensor

    def __init__(self, normalizer: Normalizer, settings: BoDiffusionSettings):
        super().__init__(normalizer, settings.frames)
        self.noise_weight, self.bound_weight = settings.noise_weight, settings.bound_weight
        self.noise_seed = settings.noise_seed
        self.is_stream, self.takes_whole_clip = not settings.offline, settings.offline
        sampler = {"ancestral": AncestralDiffusion, "released": ReleasedAncestralDiffusion}[settings.sampler]
        self.diffusion = sampler(settings.diffusion_steps, settings.sampling_steps)
        self.time = TimeEmbedding(settings.width, SINES)
        self.spread = nn.Linear(len(TRACKED), N_JOINTS, bias=False)
        self.stem = nn.Linear(N_JOINTS * (NOISY + CHANNELS), settings.width)
        self.places = nn.Parameter(torch.zeros(settings.frames, settings.width), requires_grad=False)
        self.blocks = nn.ModuleList(DiTBlock(settings.width, settings.heads) for _ in range(settings.depth))
        self.head = nn.Linear(settings.width, N_JOINTS * (NOISY + CHANNELS))
        self.joint_head = nn.Linear(NOISY + CHANNELS, 2 * NOISY)
        noises = torch.stack(list(self.draw_noise(settings.frames)))  # more with more sampling steps
        self.register_buffer("noises", noises, persistent=False)

    def draw_noise(self, frames: int) -> Iterator[Tensor]:
        """Draw the noise (N, 132) of each draw for a sample of N frames, always with `noise_seed`.

        Four draws at a time save memory. They equal one call for all draws, because torch fills 16 numbers at
        a time.
        """
        draw = torch.Generator().manual_seed(self.noise_seed)
        for first in range(0, self.diffusion.noise_draws, 4):
            count = min(4, self.diffusion.noise_draws - first)
            yield from torch.randn(count, frames, ROTATION.stop, generator=draw)

    def compute_limits(self) -> tuple[Tensor, Tensor]:
        """Return the limits of 6D rotations, -1 and 1, in network space: lower and upper limits (132,)."""
        mean, std = (part[SPARSE_DIM:][ROTATION] for part in (self.normalizer.mean, self.normalizer.std))
        return (-1 - mean) / std, (1 - mean) / std

    def mix_input_thirds(self, encoded: Tensor) -> Tensor:
        """Spread inputs (..., 54) over the joints (..., 22, 18), mixing the thirds of the input vector."""
        thirds = encoded.unflatten(-1, (len(TRACKED), CHANNELS))
        return self.spread(thirds.transpose(-1, -2)).transpose(-1, -2)

    def denoise(self, noisy: Tensor, time: Tensor, encoded: Tensor) -> DenoiserOutput:
        """Predict the noise in rotations (B, T, 132), and each step's variance between its limits.

        Args:
            noisy: noisy rotations (B, T, 132).
            time: diffusion times (B,).
            encoded: inputs (B, T, 54) in network space.
        """
        joints = torch.cat([noisy.unflatten(-1, (N_JOINTS, NOISY)), self.mix_input_thirds(encoded)], -1)
        h, embedding = self.stem(joints.flatten(-2)) + self.places, F.silu(self.time(time))
        for block in self.blocks:
            h = block(h, embedding)
        outputs = self.joint_head(self.head(h).unflatten(-1, (N_JOINTS, -1)))
        return DenoiserOutput(*(part.flatten(-2).to(noisy) for part in outputs.chunk(2, -1)))

    def step(self, noisy: Tensor, encoded: Tensor, index: int) -> tuple[Tensor, Tensor]:
        """Return mean and variance (B, T, 132) after a sampling step, given motion and inputs (B, T, 54)."""
        time = self.diffusion.find_times(index, noisy)
        return self.diffusion.step(noisy, self.denoise(noisy, time, encoded), index, self.compute_limits())

    def predict_rotations(self, encoded: Tensor) -> Tensor:

        def step(noisy: Tensor, index: int) -> tuple[Tensor, Tensor]:
            mean, variance = self.step(noisy, encoded, index)
            return mean, variance.sqrt()

        return self.diffusion.sample(step, self.noises[:, None].expand(-1, len(encoded), -1, -1))

    def predict_clip(self, sparse: Tensor) -> Tensor:
        """Sample a clip's world motion (N, 198) from its world inputs (N, 54), N >= T, all windows together.

        A window begins every T // 2 frames, and the last window ends with the clip. After every sampling
        step, overlapping windows are averaged (Castillo et al. 2023; the released code drops the clip's
        tail).
        """
        count, size = len(sparse), self.frames
        begin = torch.tensor([*range(0, count - size, size // 2), count - size], device=sparse.device)
        windows = begin[:, None] + torch.arange(size, device=sparse.device)
        encoded = self.normalizer.encode_sparse(sparse, self.normalizer.find_origin(sparse))[windows]
        times_covered = torch.bincount(windows.flatten(), minlength=count)[:, None]

        def sum_parts(parts: Tensor) -> Tensor:
            return parts.new_zeros(count, ROTATION.stop).index_add(0, windows.flatten(), parts.flatten(0, 1))

        def step(noisy: Tensor, index: int) -> tuple[Tensor, Tensor]:
            mean, variance = self.step(noisy[windows], encoded, index)
            return sum_parts(mean) / times_covered, sum_parts(variance).sqrt() / times_covered

        rotation = self.diffusion.sample(step, (noise.to(self.noises) for noise in self.draw_noise(count)))
        return self.normalizer.decode_rotations(rotation, sparse)

    def compute_training_outputs(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Add noise to the truth, and denoise it in one denoiser call; see MotionModel.

        A diffusion time is drawn for each window. The returned motion uses the noisy rotations without the
        predicted noise, clamped to their limits like in sampling. The losses compare the noise and the
        variances.
        """
        _, kept = self.append_inputs(sparse, state)
        window, frames = true_frames[..., :SPARSE_DIM], self.normalizer.encode(true_frames)
        encoded, clean = frames[..., :SPARSE_DIM], frames[..., SPARSE_DIM:][..., ROTATION]
        noisy, time, noise = self.diffusion.draw_noisy(clean)
        predicted = self.denoise(noisy, time, encoded)
        error, bound = self.diffusion.compute_losses(clean, noise, time, predicted, self.compute_limits())
        rotations = self.diffusion.remove_noise(noisy, predicted.noise, time).clamp(*self.compute_limits())
        losses = {"noise": self.noise_weight * error, "bound": self.bound_weight * bound}
        return TrainingOutputs(self.normalizer.decode_rotations(rotations, window), kept, losses)
