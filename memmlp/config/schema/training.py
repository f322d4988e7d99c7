"""The schemas of how a network is trained: conf/rollout, conf/loss, conf/hand and conf/optim."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

from omegaconf import MISSING

from memmlp.config.schema.value_rules import (
    OneOf,
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
# ruff: noqa: UP045


@dataclass
class RolloutConfig:
    """The rollout slot: which history a training step sees (conf/rollout)."""

    name: str = key(Text())
    _target_: str = MISSING


@dataclass
class TeacherForcingConfig(RolloutConfig):
    name: str = called("teacher_forcing")
    _target_: str = target("memmlp.training.rollout.TeacherForcing")


@dataclass
class OwnPredictionsConfig(RolloutConfig):
    name: str = called("own_predictions")
    _target_: str = target("memmlp.training.rollout.OwnPredictions")
    max_passes: int = at_least(1)


@dataclass
class StreamsConfig(RolloutConfig):
    name: str = called("streams")
    _target_: str = target("memmlp.training.rollout.PersistentStreams")
    streams: int = at_least(1)


@dataclass
class LossConfig:
    """The loss (conf/loss)."""

    name: str = key(Text())
    _target_: str = MISSING


@dataclass
class UncertaintyConfig(LossConfig):
    name: str = called("uncertainty")
    _target_: str = target("memmlp.training.losses.Uncertainty")
    lr: float = positive()


@dataclass
class ManualConfig(LossConfig):
    name: str = called("manual")
    _target_: str = target("memmlp.training.losses.Manual")
    rotation_all: float = at_least(0)
    rotation_velocity: float = at_least(0)
    position_branch: float = at_least(0)
    velocity_lower_body: float = at_least(0)
    hand: float = at_least(0)


@dataclass
class BaselineLossConfig(LossConfig):
    """The loss of a baseline: a complete loss, whereas the other options only weight Mem-MLP's loss terms."""


@dataclass
class AGRoLLossConfig(BaselineLossConfig):
    name: str = called("agrol")
    _target_: str = target("memmlp.training.losses.AGRoLLoss")
    error: str = one_of("norm", "square")


@dataclass
class AvatarPoserLossConfig(BaselineLossConfig):
    name: str = called("avatar_poser")
    _target_: str = target("memmlp.training.losses.AvatarPoserLoss")
    orientation: float = at_least(0)
    rotation: float = at_least(0)
    position: float = at_least(0)
    anchor: str = one_of("pelvis", "head")


@dataclass
class RPMLossConfig(BaselineLossConfig):
    name: str = called("rpm")
    _target_: str = target("memmlp.training.losses.RPMLoss")
    rotation_all: float = at_least(0)
    rotation_velocity: float = at_least(0)
    world_position: float = at_least(0)
    velocity: float = at_least(0)


@dataclass
class LossOfNetworkConfig(BaselineLossConfig):
    """No loss besides the network's own, for networks that define a loss on their outputs (BoDiffusion)."""

    name: str = called("of_network")
    _target_: str = target("memmlp.training.losses.LossOfNetwork")


@dataclass
class TermsLossConfig(BaselineLossConfig):
    """A loss made of terms of the library; null leaves a term out. Older runs lack some terms."""

    name: str = called("terms")
    _target_: str = target("memmlp.training.losses.TermsLoss")
    error: str = one_of("absolute", "square", "norm", "smooth")
    weighting: str = with_default("fixed", OneOf(("fixed", "learned")))
    lr: float = with_default(1e-2, Within(0, strict=True))
    orientation: Optional[float] = optional(Within(0))
    rotation: Optional[float] = optional(Within(0))
    global_rotation: Optional[float] = optional(Within(0))
    angle: Optional[float] = optional(Within(0))
    sixd_velocity: Optional[float] = optional(Within(0))
    turn: Optional[float] = optional(Within(0))
    position_from_pelvis: Optional[float] = optional(Within(0))
    world_position: Optional[float] = optional(Within(0))
    hand: Optional[float] = optional(Within(0))
    velocity: Optional[float] = optional(Within(0))
    velocity_3: Optional[float] = optional(Within(0))
    velocity_5: Optional[float] = optional(Within(0))
    acceleration: Optional[float] = optional(Within(0))
    jerk: Optional[float] = optional(Within(0))
    contact: Optional[float] = optional(Within(0))
    penetration: Optional[float] = optional(Within(0))
    foot_height: Optional[float] = optional(Within(0))


@dataclass
class HandConfig:
    """The hand term of Mem-MLP's loss (conf/hand)."""

    name: str = key(Text())
    _target_: str = MISSING


@dataclass
class HandPositionConfig(HandConfig):
    name: str = called("position")
    _target_: str = target("memmlp.training.losses.HandPosition")


@dataclass
class HandFKConfig(HandConfig):
    name: str = called("fk")
    _target_: str = target("memmlp.training.losses.HandFK")


@dataclass
class NoHandConfig(HandConfig):
    name: str = called("off")
    _target_: str = target("memmlp.training.losses.NoHand")


@dataclass
class TermConfig:
    """A user-defined extra term of Mem-MLP's loss; null for none.

    Its options come from the user's package, in a group `term`.
    `weight` acts with fixed weights alone (loss=manual).
    """

    name: str = key(Text())
    _target_: str = MISSING
    weight: float = at_least(0)


@dataclass
class OptimConfig:
    """The optim slot: how the network is trained (conf/optim)."""

    name: str = key(Text())
    _target_: str = MISSING
    steps: int = at_least(1)
    batch: int = at_least(1)
    lr: float = positive()
    weight_decay: float = at_least(0)
    warmup: int = with_default(0, Within(0))
    clip_norm: float = at_least(0)
    precision: str = one_of("fp32", "bf16")
    compile: bool = key()
    checkpoint_every: int = at_least(1)
    validate_every: int = at_least(1)
    log_every: int = at_least(1)


@dataclass
class ScheduledConfig(OptimConfig):
    """An optimiser whose learning rate falls."""

    final_lr: float = at_least(0)
    schedule: str = one_of("step", "cosine")
    drop_at: float = key(Within(0, 1, strict=True))
    ema: Optional[float] = optional(Within(0, 1, strict=True))


@dataclass
class AdamWConfig(ScheduledConfig):
    name: str = called("adamw")
    _target_: str = target("memmlp.training.optim.Optim")


@dataclass
class MuonConfig(ScheduledConfig):
    name: str = called("muon")
    _target_: str = target("memmlp.training.optim.Muon")
    momentum: float = fraction()
    other_lr: Optional[float] = optional(Within(0, strict=True))
    vectors: str = with_default("muon", OneOf(("adamw", "muon")))


@dataclass
class ScheduleFreeConfig(OptimConfig):
    name: str = called("schedule_free")
    _target_: str = target("memmlp.training.optim.ScheduleFree")
