"""The schemas of what makes a network: normalizer, model, predictor, memory, vqvae, refiner, upstream."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Optional, Union

from omegaconf import MISSING

from memmlp.config.schema.value_rules import (
    EachOf,
    OneOf,
    OneOfOrPath,
    Text,
    Within,
    at_least,
    called,
    fraction,
    key,
    one_of,
    optional,
    positive,
    target,
    with_default,
)

# OmegaConf reads the annotations at run time and knows Optional and Union, not `|`.
# The fields' helpers make dataclass fields, not shared defaults.
# ruff: noqa: UP007, UP045, RUF009


@dataclass
class NormalizerConfig:
    """The space in which the network sees the motion (conf/normalizer)."""

    coordinates: str = key(OneOfOrPath(("heading", "head_relative", "world")))
    z_scores: bool = key()


@dataclass
class AnyModelConfig:
    """What every network has (conf/model)."""

    name: str = key(Text())
    frames: int = at_least(2)


@dataclass
class ModelConfig(AnyModelConfig):
    """Mem-MLP's backbone (conf/model)."""

    name: str = called("mem_mlp")
    width: int = at_least(1)
    depth: int = at_least(1)


@dataclass
class BaselineConfig(AnyModelConfig):
    """A baseline network, which has no slots: memory, predictor and hand are null with it."""

    _target_: str = MISSING
    _partial_: bool = True


@dataclass
class LayeredConfig(BaselineConfig):
    """A baseline with layers of a width."""

    width: int = at_least(1)
    depth: int = at_least(1)


@dataclass
class StillPoseConfig(BaselineConfig):
    name: str = called("still_pose")
    _target_: str = target("memmlp.networks.still_pose.StillPose")


@dataclass
class AGRoLMLPConfig(LayeredConfig):
    name: str = called("agrol_mlp")
    _target_: str = target("memmlp.networks.agrol.AGRoLMLP")


@dataclass
class AGRoLDiffusionConfig(LayeredConfig):
    name: str = called("agrol_diffusion")
    _target_: str = target("memmlp.networks.agrol.AGRoLDiffusion")
    width: int = at_least(2)
    diffusion_steps: int = at_least(1)
    sampling_steps: int = at_least(1)
    noise_seed: int = at_least(0)


@dataclass
class BoDiffusionConfig(AGRoLDiffusionConfig):
    name: str = called("bodiffusion")
    _target_: str = target("memmlp.networks.bodiffusion.BoDiffusion")
    heads: int = at_least(1)
    noise_weight: float = at_least(0)
    bound_weight: float = positive()
    offline: bool = key()


@dataclass
class AvatarPoserConfig(LayeredConfig):
    name: str = called("avatar_poser")
    _target_: str = target("memmlp.networks.avatar_poser.AvatarPoser")
    heads: int = at_least(1)
    feedforward: int = at_least(1)
    dropout: float = fraction()


@dataclass
class EgoPoserConfig(AvatarPoserConfig):
    name: str = called("ego_poser")
    _target_: str = target("memmlp.networks.ego_poser.EgoPoser")


@dataclass
class HMDPoserConfig(AvatarPoserConfig):
    name: str = called("hmd_poser")
    _target_: str = target("memmlp.networks.hmd_poser.HMDPoser")
    width: int = at_least(4)
    encoder_layers: int = at_least(1)
    shape_weight: float = at_least(0)


@dataclass
class VAEHMDConfig(LayeredConfig):
    name: str = called("vae_hmd")
    _target_: str = target("memmlp.networks.vae_hmd.VAEHMD")
    latent: int = at_least(1)
    dropout: float = fraction()
    divergence_weight: float = at_least(0)


@dataclass
class RPMConfig(AvatarPoserConfig):
    name: str = called("rpm")
    _target_: str = target("memmlp.networks.rpm.RPM")
    context: int = at_least(1)
    horizon: int = at_least(1)
    own_dropout: bool = with_default(True)


@dataclass
class AvatarJLMConfig(AvatarPoserConfig):
    name: str = called("avatar_jlm")
    _target_: str = target("memmlp.networks.avatar_jlm.AvatarJLM")
    width: int = at_least(4)
    coarse_weight: float = at_least(0)


@dataclass
class RecurrentPoserConfig(LayeredConfig):
    """This project's own network, which has no slots either."""

    name: str = called("recurrent_poser")
    _target_: str = target("memmlp.networks.recurrent_poser.RecurrentPoser")
    cell: str = one_of("gru", "lstm", "mingru", "lru")
    output: str = with_default("local", OneOf(("local", "global", "reaching")))
    expansion: int = at_least(1)
    members: int = at_least(1)


@dataclass
class SAGEConfig(LayeredConfig):
    name: str = called("sage")
    _target_: str = target("memmlp.networks.sage_net.SAGENet")
    width: int = at_least(1)
    heads: int = at_least(1)
    code_width: int = at_least(2)
    code_depth: int = at_least(1)
    code_heads: int = at_least(1)
    dropout: float = fraction()
    diffusion_steps: int = at_least(1)
    sampling_steps: int = at_least(1)
    noise: float = at_least(0)
    noise_seed: int = at_least(0)


@dataclass
class ManikinSConfig(AvatarPoserConfig):
    name: str = called("manikin_s")
    _target_: str = target("memmlp.networks.manikin.ManikinS")
    parts_weight: float = at_least(0)
    turned: bool = key()


@dataclass
class ManikinLConfig(AvatarJLMConfig):
    name: str = called("manikin_l")
    _target_: str = target("memmlp.networks.manikin.ManikinL")
    parts_weight: float = at_least(0)
    turned: bool = key()
    offline: bool = key()


@dataclass
class PredictorConfig:
    """The predictor slot (conf/predictor)."""

    name: str = key(Text())
    _target_: str = MISSING
    _partial_: bool = True
    depth: int = at_least(0)


@dataclass
class TwoBranchConfig(PredictorConfig):
    name: str = called("two_branch")
    _target_: str = target("memmlp.networks.predictor.TwoBranch")


@dataclass
class RotationOnlyConfig(PredictorConfig):
    name: str = called("rotation_only")
    _target_: str = target("memmlp.networks.predictor.RotationOnly")


@dataclass
class TwoBranchMemoryConfig(PredictorConfig):
    name: str = called("two_branch_memory")
    _target_: str = target("memmlp.networks.predictor.TwoBranchMemory")
    depth: int = at_least(1)


@dataclass
class RotationOnlyMemoryConfig(PredictorConfig):
    name: str = called("rotation_only_memory")
    _target_: str = target("memmlp.networks.predictor.RotationOnlyMemory")
    depth: int = at_least(1)


@dataclass
class MemoryConfig:
    """The memory slot (conf/memory)."""

    name: str = key(Text())
    _target_: str = MISSING
    _partial_: bool = True


@dataclass
class NoMemoryConfig(MemoryConfig):
    name: str = called("none")
    _target_: str = target("memmlp.networks.memory.NoMemory")


@dataclass
class OwnPastMemoryConfig(MemoryConfig):
    """What the memories of the network's own past, with and without code-vectors, have in common."""

    layers: list[int] = key(EachOf(Within(1)))
    width: int = at_least(1)
    shift: str = one_of("frame", "window")
    history: str = one_of("first", "latest")
    fusion: str = one_of("residual", "plain")
    blend: Union[int, float, str] = key(Within(0, 1, words=("sampled",)))


@dataclass
class NoCodesMemoryConfig(OwnPastMemoryConfig):
    name: str = called("no_codes")
    _target_: str = target("memmlp.networks.own_past_memory.NoCodesMemory")


@dataclass
class CodeMemoryConfig(OwnPastMemoryConfig):
    name: str = called("vq")
    _target_: str = target("memmlp.networks.own_past_memory.CodeMemory")


@dataclass
class JointCodeMemoryConfig(OwnPastMemoryConfig):
    name: str = called("vq_joint")
    _target_: str = target("memmlp.networks.own_past_memory.JointCodeMemory")


@dataclass
class RecurrentMemoryConfig(MemoryConfig):
    """What the recurrent memories, LSTM and GRU, have in common."""

    layers: list[int] = key(EachOf(Within(1)))
    width: int = at_least(1)
    fusion: str = one_of("residual", "plain")


@dataclass
class LSTMMemoryConfig(RecurrentMemoryConfig):
    name: str = called("lstm")
    _target_: str = target("memmlp.networks.recurrent_memory.LSTMMemory")


@dataclass
class GRUMemoryConfig(RecurrentMemoryConfig):
    name: str = called("gru")
    _target_: str = target("memmlp.networks.recurrent_memory.GRUMemory")


@dataclass
class RefinerConfig:
    """What corrects the stream of a network (conf/refiner); null for nothing."""

    name: str = key(Text())
    _target_: str = MISSING


@dataclass
class SAGERefinerConfig(RefinerConfig):
    name: str = called("sage")
    _target_: str = target("memmlp.networks.refiner.SAGERefiner")
    width: int = at_least(1)
    depth: int = at_least(1)
    frames: int = at_least(4)
    pieces: int = at_least(1)
    lr: Optional[float] = optional(Within(0, strict=True))
    velocities: str = with_default("joints", OneOf(("rotations", "joints")))


@dataclass
class UpstreamConfig:
    """What of a network is trained before the whole of it (conf/upstream); null for nothing."""

    name: str = key(Text())
    _target_: str = MISSING


@dataclass
class PartConfig:
    """How a part of a network is trained: AdamW, whose learning rate falls at some steps."""

    steps: int = at_least(1)
    batch: int = at_least(1)
    lr: float = positive()
    lr_drops_at: list[float] = key(EachOf(Within(0, 1), empty=True))
    lr_drop: float = positive()


@dataclass
class SAGEUpstreamConfig(UpstreamConfig):
    name: str = called("sage")
    _target_: str = target("memmlp.training.train_sage.SAGEUpstream")
    upper_codes: PartConfig = field(default_factory=PartConfig)
    lower_codes: PartConfig = field(default_factory=PartConfig)
    upper_diffusion: PartConfig = field(default_factory=PartConfig)
    lower_diffusion: PartConfig = field(default_factory=PartConfig)
    decoder: PartConfig = field(default_factory=PartConfig)


@dataclass
class VQVAEConfig:
    """The VQ-VAE and how it is trained (conf/vqvae); exactly one of `epochs` and `steps` is set."""

    codes: int = at_least(1)
    width: int = at_least(1)
    encoder_depth: int = at_least(0)
    decoder_depth: int = at_least(0)
    commitment: float = at_least(0)
    decay: float = key(Within(0, 1, strict=True))
    codebook: str = one_of("ema", "gradient")
    seed: int = key(Within(0, 2**63 - 1))
    epochs: Optional[float] = positive()
    steps: Optional[int] = at_least(1)
    batch: int = at_least(1)
    lr: float = positive()
    weight_decay: float = at_least(0)
