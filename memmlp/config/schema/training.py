"""The schemas of how it is trained: conf/rollout, loss, hand and optim."""

from __future__ import annotations

from dataclasses import dataclass

from omegaconf import MISSING

from memmlp.config.schema.rules import Text, Within, at_least, called, key, one_of, positive, target

# OmegaConf reads the annotations at run time and knows Optional and Union, not `|`.
# The fields' helpers make dataclass fields, not shared defaults.


@dataclass
class Rollout:
    name: str = key(Text())
    _target_: str = MISSING


@dataclass
class TeacherForcing(Rollout):
    name: str = called("teacher_forcing")
    _target_: str = target("memmlp.training.rollout.TeacherForcing")


@dataclass
class OwnPredictions(Rollout):
    name: str = called("own_predictions")
    _target_: str = target("memmlp.training.rollout.OwnPredictions")
    max_passes: int = at_least(1)


@dataclass
class Streams(Rollout):
    name: str = called("streams")
    _target_: str = target("memmlp.training.rollout.PersistentStreams")
    streams: int = at_least(1)


@dataclass
class Loss:
    name: str = key(Text())
    _target_: str = MISSING


@dataclass
class Uncertainty(Loss):
    name: str = called("uncertainty")
    _target_: str = target("memmlp.training.losses.Uncertainty")
    lr: float = positive()


@dataclass
class Manual(Loss):
    name: str = called("manual")
    _target_: str = target("memmlp.training.losses.Manual")
    rotation: float = at_least(0)
    rotation_velocity: float = at_least(0)
    position: float = at_least(0)
    velocity: float = at_least(0)
    hand: float = at_least(0)


@dataclass
class BaselineLoss(Loss):
    """A whole loss, where the others are weights of Mem-MLP's terms."""


@dataclass
class AGRoLLoss(BaselineLoss):
    name: str = called("agrol")
    _target_: str = target("memmlp.training.losses.AGRoLLoss")
    error: str = one_of("norm", "square")


@dataclass
class AvatarPoserLoss(BaselineLoss):
    name: str = called("avatar_poser")
    _target_: str = target("memmlp.training.losses.AvatarPoserLoss")
    orientation: float = at_least(0)
    rotation: float = at_least(0)
    position: float = at_least(0)
    anchor: str = one_of("pelvis", "head")


@dataclass
class Hand:
    name: str = key(Text())
    _target_: str = MISSING


@dataclass
class HandPosition(Hand):
    name: str = called("position")
    _target_: str = target("memmlp.training.losses.HandPosition")


@dataclass
class HandFK(Hand):
    name: str = called("fk")
    _target_: str = target("memmlp.training.losses.HandFK")


@dataclass
class NoHand(Hand):
    name: str = called("off")
    _target_: str = target("memmlp.training.losses.NoHand")


@dataclass
class Optim:
    steps: int = at_least(1)
    batch: int = at_least(1)
    lr: float = positive()
    final_lr: float = at_least(0)
    schedule: str = one_of("step", "cosine")
    drop_at: float = key(Within(0, 1, strict=True))
    weight_decay: float = at_least(0)
    clip_norm: float = at_least(0)
    precision: str = one_of("fp32", "bf16")
    compile: bool = key()
    checkpoint_every: int = at_least(1)
    validate_every: int = at_least(1)
    log_every: int = at_least(1)
