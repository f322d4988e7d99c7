"""The whole config, and the schemas of all options by name."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Optional

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf

from memmlp.config.schema.data import Data, ListData, SeededData, SubsetData, SynthData
from memmlp.config.schema.network import (
    VQVAE,
    AGRoLDiffusion,
    AGRoLMLP,
    AvatarPoser,
    CodeMemory,
    Frame,
    GRUMemory,
    JointCodeMemory,
    LSTMMemory,
    Memory,
    Model,
    NoCodesMemory,
    NoMemory,
    Predictor,
    RotationOnly,
    RotationOnlyMemory,
    TwoBranch,
    TwoBranchMemory,
)
from memmlp.config.schema.rules import (
    EachOf,
    OneOf,
    Text,
    Within,
    at_least,
    called,
    key,
    one_of,
    positive,
    target,
)
from memmlp.config.schema.training import (
    AGRoLLoss,
    AvatarPoserLoss,
    Hand,
    HandFK,
    HandPosition,
    Loss,
    Manual,
    NoHand,
    Optim,
    OwnPredictions,
    Rollout,
    Streams,
    TeacherForcing,
    Uncertainty,
)

# OmegaConf reads the annotations at run time and knows Optional and Union, not `|`.
# The fields' helpers make dataclass fields, not shared defaults.
# ruff: noqa: UP045, RUF009


@dataclass
class Paths:
    outputs: str = key(Text())


@dataclass
class Profile:
    """The sizes that a scale of work needs; the groups read them, and any can be set in its group instead."""

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
    memory_shift: str = one_of("frame", "window")
    memory_history: str = one_of("first", "latest")
    ik: str = one_of("off", "lbfgs")
    agrol_frames: int = at_least(2)
    avatar_poser_frames: int = at_least(2)
    avatar_poser_width: int = at_least(1)
    avatar_poser_feedforward: int = at_least(1)


@dataclass
class Evaluation:
    modes: list[str] = key(EachOf(OneOf(("window", "stream"))))
    batch: int = at_least(1)
    ik: str = one_of("off", "lbfgs")
    ik_iterations: int = at_least(1)


@dataclass
class Export:
    latency_steps: int = at_least(1)
    graph: str = one_of("auto", "streaming", "naive")
    precision: str = one_of("fp32", "int8")


@dataclass
class Tracking:
    name: str = key(Text())
    _target_: str = MISSING


@dataclass
class MLflowTracking(Tracking):
    name: str = called("mlflow")
    _target_: str = target("memmlp.runs.tracking.MLflowTracking")
    uri: Optional[str] = key()


@dataclass
class NoTracking(Tracking):
    name: str = called("none")
    _target_: str = target("memmlp.runs.tracking.NoTracking")


@dataclass
class Config:
    """The whole config."""

    seed: int = key(Within(0, 2**63 - 1))
    device: str = one_of("auto", "cpu", "cuda")
    threads: int = at_least(0)
    force: bool = key()
    save_predictions: Optional[str] = key()
    paths: Paths = field(default_factory=Paths)
    profile: Profile = field(default_factory=Profile)
    data: Data = field(default_factory=Data)
    frame: Frame = field(default_factory=Frame)
    model: Model = field(default_factory=Model)
    memory: Optional[Memory] = None
    predictor: Optional[Predictor] = None
    vqvae: VQVAE = field(default_factory=VQVAE)
    rollout: Rollout = field(default_factory=Rollout)
    loss: Loss = field(default_factory=Loss)
    hand: Optional[Hand] = None
    optim: Optim = field(default_factory=Optim)
    evaluation: Evaluation = field(default_factory=Evaluation)
    export: Export = field(default_factory=Export)
    tracking: Tracking = field(default_factory=Tracking)


SCHEMAS: dict[str, type] = {
    "config": Config,
    "profile": Profile,
    "data_synth": SynthData,
    "data_seeded": SeededData,
    "data_lists": ListData,
    "data_subsets": SubsetData,
    "frame": Frame,
    "model": Model,
    "model_agrol_mlp": AGRoLMLP,
    "model_agrol_diffusion": AGRoLDiffusion,
    "model_avatar_poser": AvatarPoser,
    "predictor_two_branch": TwoBranch,
    "predictor_two_branch_memory": TwoBranchMemory,
    "predictor_rotation_only": RotationOnly,
    "predictor_rotation_only_memory": RotationOnlyMemory,
    "memory_none": NoMemory,
    "memory_no_codes": NoCodesMemory,
    "memory_vq": CodeMemory,
    "memory_vq_joint": JointCodeMemory,
    "memory_lstm": LSTMMemory,
    "memory_gru": GRUMemory,
    "vqvae": VQVAE,
    "rollout_teacher_forcing": TeacherForcing,
    "rollout_own_predictions": OwnPredictions,
    "rollout_streams": Streams,
    "loss_uncertainty": Uncertainty,
    "loss_manual": Manual,
    "loss_agrol": AGRoLLoss,
    "loss_avatar_poser": AvatarPoserLoss,
    "hand_position": HandPosition,
    "hand_fk": HandFK,
    "hand_off": NoHand,
    "optim": Optim,
    "evaluation": Evaluation,
    "export": Export,
    "tracking_mlflow": MLflowTracking,
    "tracking_none": NoTracking,
}


GROUPS = {
    "paths": Paths, "profile": Profile, "frame": Frame, "model": Model, "memory": Memory, "vqvae": VQVAE,
    "predictor": Predictor, "rollout": Rollout, "loss": Loss, "hand": Hand, "optim": Optim,
    "evaluation": Evaluation, "export": Export, "tracking": Tracking,
}  # fmt: skip
DATA = {"seeded": SeededData, "lists": ListData, "subsets": SubsetData}


RENAMED = {"tracker": "tracking"}
"""Groups that runs of version 0.1 know by other names."""


def restored(config: Mapping[str, Any]) -> DictConfig:
    """The typed config of a run's record, its classes found where this version has them.

    Raises OmegaConf's errors, or KeyError, where it is none of this version's.
    """
    cfg = OmegaConf.structured(Config)
    for group, content in ((RENAMED.get(name, name), content) for name, content in config.items()):
        cfg[group] = _restored(group, content) if isinstance(content, Mapping) else content
    return cfg


def _restored(group: str, content: Mapping[str, Any]) -> Any:
    """A typed group. A component that is not of this package keeps the path of its class."""
    if group == "data":
        schema = SynthData if content["synth"] else DATA[content["split"]["name"]]
        return OmegaConf.merge(OmegaConf.structured(schema), _bare(content))
    shipped = SCHEMAS.get(f"{group}_{content.get('name')}")
    own = _bare(content) if shipped else dict(content)
    return OmegaConf.merge(OmegaConf.structured(shipped or GROUPS[group]), own)


def _bare(content: Mapping[str, Any]) -> dict[str, Any]:
    """A group without the paths of its classes: those are the schema's."""
    bare = {key: _bare(value) if isinstance(value, Mapping) else value for key, value in content.items()}
    return {key: value for key, value in bare.items() if key != "_target_"}


@functools.cache
def register() -> None:
    """Make the schemas known to Hydra."""
    for name, node in SCHEMAS.items():
        ConfigStore.instance().store(group="schema", name=name, node=node, provider="memmlp")
