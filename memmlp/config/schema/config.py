"""The schema of the whole config, and the schemas of all options by name."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass, field
from typing import Optional

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from memmlp.common.plugin import METRICS
from memmlp.config.schema.data import (
    DataConfig,
    ListDataConfig,
    SeededDataConfig,
    SubsetDataConfig,
    SynthDataConfig,
)
from memmlp.config.schema.network import (
    AGRoLDiffusionConfig,
    AGRoLMLPConfig,
    AnyModelConfig,
    AvatarJLMConfig,
    AvatarPoserConfig,
    BoDiffusionConfig,
    CodeMemoryConfig,
    EgoPoserConfig,
    GRUMemoryConfig,
    HMDPoserConfig,
    JointCodeMemoryConfig,
    LSTMMemoryConfig,
    ManikinLConfig,
    ManikinSConfig,
    MemoryConfig,
    ModelConfig,
    NoCodesMemoryConfig,
    NoMemoryConfig,
    NormalizerConfig,
    PredictorConfig,
    RecurrentPoserConfig,
    RefinerConfig,
    RotationOnlyConfig,
    RotationOnlyMemoryConfig,
    RPMConfig,
    SAGEConfig,
    SAGERefinerConfig,
    SAGEUpstreamConfig,
    StillPoseConfig,
    TwoBranchConfig,
    TwoBranchMemoryConfig,
    UpstreamConfig,
    VAEHMDConfig,
    VQVAEConfig,
)
from memmlp.config.schema.training import (
    AdamWConfig,
    AGRoLLossConfig,
    AvatarPoserLossConfig,
    HandConfig,
    HandFKConfig,
    HandPositionConfig,
    LossConfig,
    LossOfNetworkConfig,
    ManualConfig,
    MuonConfig,
    NoHandConfig,
    OptimConfig,
    OwnPredictionsConfig,
    RolloutConfig,
    RPMLossConfig,
    ScheduleFreeConfig,
    StreamsConfig,
    TeacherForcingConfig,
    TermConfig,
    TermsLossConfig,
    UncertaintyConfig,
)
from memmlp.config.schema.value_rules import (
    DEVICE,
    EachOf,
    OneOf,
    OneOfOrPath,
    Registered,
    Text,
    Within,
    at_least,
    called,
    empty_list,
    key,
    one_of,
    optional,
    positive,
    target,
    with_default,
)
from memmlp.runs.deployment_folder import ONNX_FILES

# OmegaConf reads the annotations at run time and knows Optional and Union, not `|`.
# The fields' helpers make dataclass fields, not shared defaults.
# ruff: noqa: UP045, RUF009


@dataclass
class PathsConfig:
    """Where runs, caches and sweeps are kept."""

    outputs: str = key(Text())


@dataclass
class ProfileConfig:
    """The sizes that fit a scale of work (tests, a CPU, a GPU), and readings of the paper that go with them.

    The other groups read their defaults from here; any of them can be overridden in its own group.
    """

    synth_minutes: Optional[float] = optional(Within(0, strict=True))
    frames: int = at_least(2)
    width: int = at_least(1)
    depth: int = at_least(1)
    memory_layers: list[int] = key(EachOf(Within(1)))
    memory_width: int = at_least(1)
    steps: int = at_least(1)
    batch: int = at_least(1)
    lr: float = positive()
    final_lr: float = at_least(0)
    schedule: str = one_of("step", "cosine")
    ema: Optional[float] = optional(Within(0, 1, strict=True))
    checkpoint_every: int = at_least(1)
    validate_every: int = at_least(1)
    log_every: int = at_least(1)
    streams: int = at_least(1)
    codes: int = at_least(1)
    code_width: int = at_least(1)
    code_epochs: Optional[float] = positive()
    code_steps: Optional[int] = at_least(1)
    code_batch: int = at_least(1)
    code_lr: float = positive()
    evaluation_batch: int = at_least(1)
    latency_steps: int = at_least(1)
    coordinates: str = with_default("heading", OneOfOrPath(("heading", "head_relative", "world")))
    z_scores: bool = with_default(True)
    memory_shift: str = one_of("frame", "window")
    memory_history: str = one_of("first", "latest")
    ik: str = one_of("off", "lbfgs", "arms")
    agrol_frames: int = at_least(2)
    baseline_frames: int = at_least(2)
    avatar_poser_width: int = at_least(1)
    avatar_poser_feedforward: int = at_least(1)
    ego_poser_frames: Optional[int] = optional(Within(2))
    hmd_poser_width: Optional[int] = optional(Within(4))
    hmd_poser_encoder_layers: Optional[int] = optional(Within(1))
    hmd_poser_feedforward: Optional[int] = optional(Within(1))
    vae_hmd_width: Optional[int] = optional(Within(1))
    avatar_jlm_width: Optional[int] = optional(Within(4))
    avatar_jlm_depth: Optional[int] = optional(Within(1))
    avatar_jlm_heads: Optional[int] = optional(Within(1))
    avatar_jlm_feedforward: Optional[int] = optional(Within(1))
    bodiffusion_width: Optional[int] = optional(Within(2))
    bodiffusion_depth: Optional[int] = optional(Within(1))
    bodiffusion_heads: Optional[int] = optional(Within(1))
    bodiffusion_sampling_steps: Optional[int] = optional(Within(1))
    sage_frames: Optional[int] = optional(Within(2))
    sage_width: Optional[int] = optional(Within(1))
    sage_depth: Optional[int] = optional(Within(1))
    sage_heads: Optional[int] = optional(Within(1))
    sage_code_width: Optional[int] = optional(Within(2))
    sage_code_depth: Optional[int] = optional(Within(1))
    sage_code_heads: Optional[int] = optional(Within(1))
    sage_batch: Optional[int] = optional(Within(1))
    sage_code_steps: Optional[int] = optional(Within(1))
    sage_upper_steps: Optional[int] = optional(Within(1))
    sage_lower_steps: Optional[int] = optional(Within(1))
    sage_decoder_steps: Optional[int] = optional(Within(1))
    sage_diffusion_lr: Optional[float] = optional(Within(0, strict=True))
    sage_lr: Optional[float] = optional(Within(0, strict=True))
    rpm_frames: Optional[int] = optional(Within(2))
    rpm_width: Optional[int] = optional(Within(1))
    rpm_depth: Optional[int] = optional(Within(1))
    rpm_feedforward: Optional[int] = optional(Within(1))
    recurrent_poser_frames: Optional[int] = optional(Within(2))
    recurrent_poser_batch: Optional[int] = optional(Within(1))
    recurrent_poser_width: Optional[int] = optional(Within(1))
    recurrent_poser_depth: Optional[int] = optional(Within(1))
    recurrent_poser_members: Optional[int] = optional(Within(1))
    recurrent_poser_lr: Optional[float] = optional(Within(0, strict=True))
    recurrent_poser_warmup: Optional[int] = optional(Within(0))
    recurrent_poser_weight_decay: Optional[float] = optional(Within(0))
    refiner_width: Optional[int] = optional(Within(1))
    refiner_frames: Optional[int] = optional(Within(4))
    refiner_pieces: Optional[int] = optional(Within(1))


@dataclass
class EvaluationConfig:
    """How a trained network is evaluated (conf/evaluation)."""

    modes: list[str] = key(EachOf(OneOf(("window", "stream"))))
    batch: int = at_least(1)
    ik: str = one_of("off", "lbfgs", "arms")
    ik_iterations: int = at_least(1)
    metrics: list[str] = empty_list(EachOf(Registered(METRICS), empty=True))


@dataclass
class ExportConfig:
    """How a trained network is exported and timed (conf/export)."""

    latency_steps: int = at_least(1)
    graph: str = one_of("auto", "streaming", "naive", "off")
    precision: str = one_of(*ONNX_FILES)
    alone: bool = with_default(False)
    opset: int = with_default(18, Within(15, 26))  # memmlp.deploy.opsets.OPSETS, without importing onnx


@dataclass
class LoggerConfig:
    """Where runs are shown beside their folders (conf/loggers), by the name of the logger."""

    name: str = key(Text())
    _target_: str = MISSING


@dataclass
class MLflowConfig(LoggerConfig):
    name: str = called("mlflow")
    _target_: str = target("memmlp.runs.loggers.mlflow.MLflow")
    uri: Optional[str] = key()


@dataclass
class TensorBoardConfig(LoggerConfig):
    name: str = called("tensorboard")
    _target_: str = target("memmlp.runs.loggers.tensorboard.TensorBoard")


@dataclass
class WandBConfig(LoggerConfig):
    name: str = called("wandb")
    _target_: str = target("memmlp.runs.loggers.wandb.WandB")
    project: str = key(Text())


@dataclass
class Config:
    """The whole config of `memmlp train`."""

    seed: int = key(Within(0, 2**63 - 1))
    device: str = key(DEVICE)
    threads: int = at_least(0)
    force: bool = key()
    plugins: list[str] = empty_list(EachOf(empty=True))
    save_predictions: Optional[str] = key()
    paths: PathsConfig = field(default_factory=PathsConfig)
    profile: ProfileConfig = field(default_factory=ProfileConfig)
    data: DataConfig = field(default_factory=DataConfig)
    normalizer: NormalizerConfig = field(default_factory=NormalizerConfig)
    model: AnyModelConfig = field(default_factory=AnyModelConfig)
    memory: Optional[MemoryConfig] = None
    predictor: Optional[PredictorConfig] = None
    vqvae: VQVAEConfig = field(default_factory=VQVAEConfig)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    hand: Optional[HandConfig] = None
    term: Optional[TermConfig] = None
    refiner: Optional[RefinerConfig] = None
    upstream: Optional[UpstreamConfig] = None
    optim: OptimConfig = field(default_factory=OptimConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    export: ExportConfig = field(default_factory=ExportConfig)
    loggers: dict[str, LoggerConfig] = field(default_factory=dict)


SCHEMAS: dict[str, type] = {
    "config": Config,
    "profile": ProfileConfig,
    "data_synth": SynthDataConfig,
    "data_seeded": SeededDataConfig,
    "data_lists": ListDataConfig,
    "data_subsets": SubsetDataConfig,
    "normalizer": NormalizerConfig,
    "model": ModelConfig,
    "model_agrol_mlp": AGRoLMLPConfig,
    "model_agrol_diffusion": AGRoLDiffusionConfig,
    "model_bodiffusion": BoDiffusionConfig,
    "model_avatar_poser": AvatarPoserConfig,
    "model_ego_poser": EgoPoserConfig,
    "model_hmd_poser": HMDPoserConfig,
    "model_rpm": RPMConfig,
    "model_avatar_jlm": AvatarJLMConfig,
    "model_vae_hmd": VAEHMDConfig,
    "model_still_pose": StillPoseConfig,
    "model_recurrent_poser": RecurrentPoserConfig,
    "model_sage": SAGEConfig,
    "model_manikin_s": ManikinSConfig,
    "model_manikin_l": ManikinLConfig,
    "predictor_two_branch": TwoBranchConfig,
    "predictor_two_branch_memory": TwoBranchMemoryConfig,
    "predictor_rotation_only": RotationOnlyConfig,
    "predictor_rotation_only_memory": RotationOnlyMemoryConfig,
    "memory_none": NoMemoryConfig,
    "memory_no_codes": NoCodesMemoryConfig,
    "memory_vq": CodeMemoryConfig,
    "memory_vq_joint": JointCodeMemoryConfig,
    "memory_lstm": LSTMMemoryConfig,
    "memory_gru": GRUMemoryConfig,
    "vqvae": VQVAEConfig,
    "rollout_teacher_forcing": TeacherForcingConfig,
    "rollout_own_predictions": OwnPredictionsConfig,
    "rollout_streams": StreamsConfig,
    "loss_uncertainty": UncertaintyConfig,
    "loss_manual": ManualConfig,
    "loss_agrol": AGRoLLossConfig,
    "loss_avatar_poser": AvatarPoserLossConfig,
    "loss_of_network": LossOfNetworkConfig,
    "loss_rpm": RPMLossConfig,
    "loss_terms": TermsLossConfig,
    "hand_position": HandPositionConfig,
    "hand_fk": HandFKConfig,
    "hand_off": NoHandConfig,
    "refiner_sage": SAGERefinerConfig,
    "upstream_sage": SAGEUpstreamConfig,
    "optim": AdamWConfig,  # its name up to version 0.2, for configs of one's own
    "optim_adamw": AdamWConfig,
    "optim_muon": MuonConfig,
    "optim_schedule_free": ScheduleFreeConfig,
    "evaluation": EvaluationConfig,
    "export": ExportConfig,
    "loggers_mlflow": MLflowConfig,
    "loggers_tensorboard": TensorBoardConfig,
    "loggers_wandb": WandBConfig,
}


GROUPS = {
    "paths": PathsConfig,
    "profile": ProfileConfig,
    "normalizer": NormalizerConfig,
    "model": ModelConfig,
    "memory": MemoryConfig,
    "vqvae": VQVAEConfig,
    "predictor": PredictorConfig,
    "rollout": RolloutConfig,
    "loss": LossConfig,
    "hand": HandConfig,
    "term": TermConfig,
    "refiner": RefinerConfig,
    "upstream": UpstreamConfig,
    "optim": OptimConfig,
    "evaluation": EvaluationConfig,
    "export": ExportConfig,
}
DATA = {"seeded": SeededDataConfig, "lists": ListDataConfig, "subsets": SubsetDataConfig}


@functools.cache
def register() -> None:
    """Make the schemas known to Hydra; later calls do nothing."""
    for name, node in SCHEMAS.items():
        ConfigStore.instance().store(group="schema", name=name, node=node, provider="memmlp")


def add_schema(option: str, schema: type) -> None:
    """Add the schema of an option of one's own, named GROUP_OPTION.

    Raises:
        ValueError: where there is one of that name, or it does not extend the schema of its slot.
    """
    slots = {**GROUPS, "loggers": LoggerConfig, "data": DataConfig}
    slot = slots.get(option.partition("_")[0])
    if slot is None or option in SCHEMAS:
        raise ValueError(f"'{option}': allowed is GROUP_OPTION with a new option of {', '.join(slots)}")
    if not (dataclasses.is_dataclass(schema) and issubclass(schema, slot)):
        raise ValueError(f"allowed is a dataclass that extends {slot.__name__}")
    SCHEMAS[option] = schema
    ConfigStore.instance().store(group="schema", name=option, node=schema, provider="plugin")
