"""SAGE-Net (Feng et al., CVPR 2024): diffusion generates latents of body halves, and a decoder the pose.

Its parts are trained one after the other (memmlp.training.train_sage), and then together.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.settings import at_least, fraction, one_of, setting, sized
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.diffusion import Diffusion, StridedDiffusion
from memmlp.networks.motion_model import NewestFrameModel, State, TrainingOutputs
from memmlp.networks.sage_parts import (
    LATENT,
    Decoder,
    HalfVQVAE,
    LowerDenoiser,
    UpperDenoiser,
    make_position_embeddings,
)
from memmlp.networks.settings import NetworkSettings, Release, make_strided_times, name_dit_blocks
from memmlp.networks.streaming import StemGraph, make_linear
from memmlp.networks.transformer import DiTBlock

DECODER = "decoder_state_dict.decoder_stacks.0"  # the released code's name of the decoder's blocks


class DenoiserAtSamplingTimes(nn.Module):
    """A denoiser for the sampling times only, with precomputed modulations.

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
        modulations = torch.stack([block.modulation(embedding) for block in self.blocks], 1)
        self.register_buffer("modulations", modulations)
        seen, noisy = weight.split([weight.shape[1] - LATENT, LATENT], 1)
        self.denoiser, self.seen, self.noisy = (
            denoiser,
            make_linear(seen, denoiser.stem.bias),
            make_linear(noisy),
        )

    def condition(self, seen: Tensor) -> Tensor:
        """Return the condition (T // 2, d) for the window's carried features (T, d)."""
        return self.seen(self.denoiser.condition.shorten(seen))

    def forward(self, noisy: Tensor, condition: Tensor, index: int) -> Tensor:
        """Map noisy latents (T // 2, 384) at sampling step `index` to clean latents."""
        h = condition + self.noisy(self.denoiser.mix_frames(noisy))
        for block, modulation in zip(self.blocks, self.modulations[index], strict=True):
            h = block.compute_newest(h, modulation.chunk(6), h.shape[-2])
        return self.denoiser.head(h)


class SAGENetGraph(StemGraph):
    """SAGE-Net's streaming graph, which carries the per-frame features of its three parts.

    The blocks' modulations by the diffusion times are the same at every step of a stream, so they are
    computed once. The decoder computes only the newest frame.
    """

    float32_modules: tuple[str, ...] = ("sparse", "decoder.heads")
    places: Tensor

    def build(self, model: Any) -> None:
        self.diffusion, self.noises, self.decoder = model.diffusion, model.noises, model.decoder
        self.upper, self.lower = (
            DenoiserAtSamplingTimes(part, model.diffusion.times[: model.diffusion.calls])
            for part in (model.upper, model.lower)
        )
        self.beside = model.lower.beside
        conditions = model.upper.condition, model.lower.condition, model.decoder.condition
        self.widths = [one.linear.out_features for one in conditions]
        self.width = sum(self.widths)

        def embed_inputs(encoded: Tensor) -> Tensor:
            return torch.cat([one.linear(one.mixture(encoded).flatten(-2)) for one in conditions], -1)

        nothing = torch.zeros(1, SPARSE_DIM).to(model.noises)
        offset = embed_inputs(nothing)
        self.sparse = make_linear((embed_inputs(torch.eye(SPARSE_DIM).to(nothing)) - offset).T, offset[0])
        self.register_buffer(
            "places",
            make_position_embeddings(nothing.new_zeros(self.frames // 2, model.decoder.stem.out_features)),
        )

    def embed_frame(self, encoded: Tensor) -> Tensor:
        return self.sparse(encoded)

    def predict_rotation(self, window: Tensor, encoded: Tensor) -> Tensor:
        for_upper, for_lower, for_decoder = window.split(self.widths, -1)
        seen = self.upper.condition(for_upper)
        upper = self.diffusion.sample(lambda noisy, index: self.upper(noisy, seen, index), self.noises[0])
        both = self.lower.condition(for_lower)
        lower = self.diffusion.sample(
            lambda noisy, index: self.lower(self.beside(torch.cat([upper, noisy], -1)), both, index),
            self.noises[1],
        )
        shortened = self.decoder.condition.shorten(for_decoder)
        h = self.decoder.stem(torch.cat([shortened, upper, lower], -1))
        newest = self.decoder.stack.predict_last(h, self.places)
        return torch.cat([head(newest) for head in self.decoder.heads], -1)


@component("model", "sage", builds="SAGENet")
@dataclass
class SAGESettings(NetworkSettings):
    """SAGE-Net (Feng et al. 2024): a diffusion model for the latents of each body half, and a decoder.

    Prerequisite runs train its parts. Then optim trains both diffusion models and the decoder together,
    through the sampler. Its refiner is refiner=sage, which can follow any network. Losses, learning rates and
    features follow its released code.
    """

    frames: int = setting(at_least(2), tiny=8, small=20, paper=20)  # T, the number of frames in a window
    width: int = setting(at_least(1), tiny=16, small=128, paper=512)  # d, the width of the diffusion models
    depth: int = setting(at_least(1), tiny=1, small=3, paper=12)  # number of blocks in each diffusion model
    # number of attention heads in the diffusion models
    heads: int = setting(at_least(1), tiny=2, small=4, paper=8)
    # the width of the VQ-VAEs and the decoder; must be even
    code_width: int = setting(at_least(2), tiny=16, small=64, paper=256)
    # number of blocks in the decoder and in each VQ-VAE's encoder and decoder
    code_depth: int = setting(at_least(1), tiny=1, small=2, paper=4)
    # number of attention heads in the VQ-VAEs and the decoder
    code_heads: int = setting(at_least(1), tiny=2, small=4, paper=4)
    dropout: float = setting(fraction(), 0.1)  # dropout in all these blocks during training
    diffusion_steps: int = setting(at_least(1), 1000)  # number of steps in the noise schedule
    sampling_steps: int = setting(at_least(1), 5)  # number of calls of each diffusion model per pose
    noise: float = setting(at_least(0), 0.01)  # standard deviation of the initial noise of sampling
    noise_seed: int = setting(at_least(0), 0)  # seed of the sampling noise, equal for all windows
    # ddim; strided: like the released code, with one denoiser call less and the noise that is left at time 0
    sampler: str = setting(one_of("ddim", "strided"), "ddim")

    learns_newest_frame: ClassVar[bool] = True
    defaults: ClassVar = {"loss": "sage", "prerequisite": "sage"}
    recipe: ClassVar = {"optim.steps": sized(20, 1000, 56000), "optim.lr": sized(5.0e-4, 5.0e-4, 8.0e-5)}
    release: ClassVar = Release(
        source="Wenchao-M/SAGE 07415ac",
        names={
            "decoder.condition.time.*": "decoder_state_dict.sparse_up_conv.*",
            "*.condition.mixture.spread.*": "*_state_dict.cond_encoder.*",
            "*.condition.linear.*": "*_state_dict.cond_encoder2.*",
            "*.condition.time.*": "*_state_dict.denoiser_upper.sparse_up_conv.*",
            "*.time.mlp.*.*": "*_state_dict.denoiser_upper.embed_timestep.mlp.*.*",
            "upper.align.*": "upper_state_dict.denoiser_upper.align_net.*",
            "lower.align.*": "lower_state_dict.denoiser_upper.upper_align_net.*",
            "lower.beside.*": "lower_state_dict.denoiser_upper.down_dim_init.*",
            "decoder.stem.*": "decoder_state_dict.post_quant_emb.*",
            "*.stem.*": "*_state_dict.denoiser_upper.down_dim.*",
            **name_dit_blocks("*.blocks.*", "*_state_dict.denoiser_upper.blocks.*"),
            "*.head.*": "*_state_dict.denoiser_upper.last.*",
            "decoder.stack.blocks.*.attention_norm.*": f"{DECODER}.blocks.*.ln1.*",
            "decoder.stack.blocks.*.attention.out.*": f"{DECODER}.blocks.*.attn.proj.*",
            "decoder.stack.blocks.*.attention.*.*": f"{DECODER}.blocks.*.attn.*.*",
            "decoder.stack.blocks.*.norm.*": f"{DECODER}.blocks.*.ln2.*",
            "decoder.stack.blocks.*.mlp.*.*": f"{DECODER}.blocks.*.mlp.*.*",
            "decoder.stack.norm.*": f"{DECODER}.ln_f.*",
            "decoder.stack.head.*": f"{DECODER}.head.*",
            "decoder.stack.convolution.*": f"{DECODER}.up_conv.conv.*",
            "decoder.heads.0.*.*": "decoder_state_dict.reg_root.*.*",
            "decoder.heads.1.*.*": "decoder_state_dict.reg_body.*.*",
        },
        sizes={
            "model.frames": ("decoder_state_dict.sparse_up_conv.weight", 1),
            "model.width": ("upper_state_dict.cond_encoder2.weight", 0),
            "model.depth": "upper_state_dict.denoiser_upper.blocks.*.attn.qkv.weight",
            "model.code_width": ("decoder_state_dict.post_quant_emb.weight", 0),
            "model.code_depth": f"{DECODER}.blocks.*.ln1.weight",
        },
        unused=(f"{DECODER}.pos.0.pe",),
        config={"model.sampler": "strided"},
    )

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        yield from super().problems(config)
        model = config["model"]
        for key in ("frames", "code_width"):  # its codes are of two frames each
            if model[key] % 2:
                yield f"model.{key}={model[key]}: must be even with model=sage"
        calls, steps = model["sampling_steps"], model["diffusion_steps"]
        if model["sampler"] == "strided" and (calls < 2 or len(make_strided_times(steps, calls)) != calls):
            yield f"model.sampling_steps={calls}: must divide {steps} and be above 1 with sampler=strided"


class SAGENet(NewestFrameModel):
    """SAGE-Net: samples the upper half's latents, then the lower half's latents, and decodes both to a pose.

    It has 120,269,534 parameters at the paper's sizes (120.27 M in Table 16); the VQ-VAEs that provide its
    training latents are not included. Every frame is predicted as the last frame of its own window, and only
    that frame has losses. Sampling always starts from the same noise, drawn with `noise_seed`, like
    AGRoLDiffusion.
    """

    graph = SAGENetGraph
    noises: Tensor

    def __init__(self, normalizer: Normalizer, settings: SAGESettings):
        super().__init__(normalizer, settings.frames)
        self.settings = settings
        sampler = {"ddim": Diffusion, "strided": StridedDiffusion}[settings.sampler]
        self.diffusion = sampler(settings.diffusion_steps, settings.sampling_steps)
        self.upper, self.lower = UpperDenoiser(settings), LowerDenoiser(settings)
        self.decoder = Decoder(settings)
        draw = torch.Generator().manual_seed(settings.noise_seed)
        self.register_buffer(
            "noises", settings.noise * torch.randn(2, settings.frames // 2, LATENT, generator=draw)
        )

    def make_codes(self, joints: tuple[int, ...]) -> HalfVQVAE:
        """Make a VQ-VAE with random weights for the body half with the given joints."""
        return HalfVQVAE(joints, self.settings)

    def sample_upper(self, encoded: Tensor) -> Tensor:
        """Sample the upper half's latents (B, T // 2, 384) for inputs (B, T, 54)."""
        condition = self.upper.condition(encoded)
        return self.diffusion.sample(
            lambda noisy, index: self.upper.denoise(
                noisy, self.diffusion.find_times(index, noisy), condition
            ),
            self.noises[0].expand(len(encoded), -1, -1),
        )

    def sample_lower(self, upper: Tensor, encoded: Tensor) -> Tensor:
        """Sample the lower half's latents for inputs (B, T, 54) and upper latents (B, T // 2, 384)."""
        condition = self.lower.condition(encoded)
        return self.diffusion.sample(
            lambda noisy, index: self.lower.denoise(
                self.lower.merge_latents(noisy, upper), self.diffusion.find_times(index, noisy), condition
            ),
            self.noises[1].expand(len(encoded), -1, -1),
        )

    def predict_rotations(self, encoded: Tensor) -> Tensor:
        upper = self.sample_upper(encoded)
        return self.decoder(upper, self.sample_lower(upper, encoded), encoded)[:, -1]

    def compute_training_outputs(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Predict the newest frame through both samplers; see MotionModel."""
        return TrainingOutputs(*self.advance(sparse, state, 1), {})
