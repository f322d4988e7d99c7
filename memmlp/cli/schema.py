"""Every key of the config: its type here, its values and their sources in conf/, its limits in `check`.

A dataclass is a group's option; ConfigStore holds it as schema/<group>_<option>, and the YAML file of the
same name starts from it, so that unknown keys and wrong types are refused when the config is composed.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Optional, Union

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from memmlp.errors import InputError

# OmegaConf reads the annotations at run time and knows Optional and Union, not `|`.
# The fields' helpers make dataclass fields, not shared defaults.
# ruff: noqa: UP007, UP045, RUF009


@dataclass(frozen=True)
class OneOf:
    """One of some words."""

    words: tuple[str, ...]

    def allows(self, value: Any) -> bool:
        """Whether the value is among them."""
        return value in self.words

    def __str__(self) -> str:
        return " or ".join(self.words)


@dataclass(frozen=True)
class Within:
    """A finite number from `low` (`above` it, if `strict`) to `high`, or one of some words."""

    low: float
    high: float = math.inf
    strict: bool = False
    words: tuple[str, ...] = ()

    def allows(self, value: Any) -> bool:
        """Whether the value is in the range or a word."""
        if not isinstance(value, int | float) or isinstance(value, bool):
            return value in self.words
        inside = self.low < value < self.high if self.strict else self.low <= value <= self.high
        return inside and math.isfinite(value)

    def __str__(self) -> str:
        more, less = ("above", "below") if self.strict else ("at least", "at most")
        top = f" and {less} {self.high:g}" if self.high < math.inf else ""
        return " or ".join([f"{more} {self.low:g}{top}", *self.words])


@dataclass(frozen=True)
class EachOf:
    """A list, not empty unless `empty`, without repetitions, of values that a rule allows."""

    rule: OneOf | Within | None = None
    empty: bool = False

    def allows(self, value: Any) -> bool:
        """Whether all items are allowed and there is one of each."""
        items = list(value)
        if not all(isinstance(item, int | float | str) for item in items):
            return False
        fits = all(self.rule is None or self.rule.allows(item) for item in items)
        return fits and len(set(items)) == len(items) and (self.empty or bool(items))

    def __str__(self) -> str:
        what = f", each {self.rule}" if self.rule else ""
        return f"a list without repetitions{'' if self.empty else ', not empty'}{what}"


@dataclass(frozen=True)
class Text:
    """A word that is not empty."""

    def allows(self, value: Any) -> bool:
        """Whether there is more than space."""
        return bool(value.strip())

    def __str__(self) -> str:
        return "text that is not empty"


@dataclass(frozen=True)
class Existing:
    """A file or folder that exists, or one of some words."""

    kind: str
    words: tuple[str, ...] = ()

    def allows(self, value: Any) -> bool:
        """Whether it is there."""
        path = Path(value)
        return value in self.words or (path.is_dir() if self.kind == "folder" else path.is_file())

    def __str__(self) -> str:
        return " or ".join([f"an existing {self.kind}", *self.words])


def key(rule: object = None) -> Any:
    """A key whose value the YAML file gives."""
    return field(default=MISSING, metadata={"rule": rule})


def target(path: str) -> Any:
    """The class that a slot's option stands for; fixed."""
    return field(default=path, metadata={"rule": OneOf((path,))})


def one_of(*words: str) -> Any:
    """A key with these words."""
    return key(OneOf(words))


def at_least(low: float) -> Any:
    """A number with a lower limit."""
    return key(Within(low))


def fraction() -> Any:
    """A number in [0, 1]."""
    return key(Within(0, 1))


def positive() -> Any:
    """A number above 0."""
    return key(Within(0, strict=True))


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
    code_steps: int = at_least(1)
    code_batch: int = at_least(1)
    code_lr: float = positive()
    evaluation_batch: int = at_least(1)
    latency_steps: int = at_least(1)
    memory_shift: str = one_of("frame", "window")
    memory_history: str = one_of("first", "latest")
    agrol_frames: int = at_least(2)
    avatar_poser_frames: int = at_least(2)
    avatar_poser_width: int = at_least(1)
    avatar_poser_feedforward: int = at_least(1)


@dataclass
class SeededSplit:
    _target_: str = target("memmlp.data.splits.SeededSplit")
    test: float = fraction()
    val: float = fraction()
    seed: int = at_least(0)
    groups: list[str] = key(EachOf(empty=True))


@dataclass
class ListSplit:
    _target_: str = target("memmlp.data.splits.ListSplit")
    folder: str = key(Existing("folder"))
    val: float = fraction()
    seed: int = at_least(0)
    groups: list[str] = key(EachOf(empty=True))


@dataclass
class SubsetSplit:
    _target_: str = target("memmlp.data.splits.SubsetSplit")
    train: list[str] = key(EachOf())
    test: list[str] = key(EachOf())
    val: float = fraction()
    seed: int = at_least(0)
    groups: list[str] = key(EachOf(empty=True))


@dataclass
class Synth:
    minutes: float = positive()
    seed: int = at_least(0)


@dataclass
class Data:
    name: str = key(Text())
    body: str = key(Existing("file", ("builtin",)))
    min_frames: int = at_least(2)
    strict: bool = key()


@dataclass
class SynthData(Data):
    root: str = key(Text())
    synth: Synth = field(default_factory=Synth)
    split: SeededSplit = field(default_factory=SeededSplit)


@dataclass
class SeededData(Data):
    root: str = key(Existing("folder"))
    synth: Optional[Synth] = None
    split: SeededSplit = field(default_factory=SeededSplit)


@dataclass
class ListData(Data):
    root: str = key(Existing("folder"))
    synth: Optional[Synth] = None
    split: ListSplit = field(default_factory=ListSplit)


@dataclass
class SubsetData(Data):
    root: str = key(Existing("folder"))
    synth: Optional[Synth] = None
    split: SubsetSplit = field(default_factory=SubsetSplit)


@dataclass
class Frame:
    coordinates: str = one_of("heading", "head_relative", "world")
    normalize: bool = key()


@dataclass
class Model:
    frames: int = at_least(2)
    width: int = at_least(1)
    depth: int = at_least(1)


@dataclass
class Reference(Model):
    """A network without slots: it leaves memory, predictor and hand empty."""

    _target_: str = MISSING
    _partial_: bool = True


@dataclass
class AGRoLMLP(Reference):
    _target_: str = target("memmlp.reference.agrol.AGRoLMLP")


@dataclass
class AGRoLDiffusion(Reference):
    _target_: str = target("memmlp.reference.agrol.AGRoLDiffusion")
    width: int = at_least(2)
    diffusion_steps: int = at_least(1)
    sampling_steps: int = at_least(1)
    noise_seed: int = at_least(0)


@dataclass
class AvatarPoser(Reference):
    _target_: str = target("memmlp.reference.avatar_poser.AvatarPoser")
    heads: int = at_least(1)
    feedforward: int = at_least(1)
    dropout: float = fraction()


@dataclass
class Predictor:
    _target_: str = MISSING
    _partial_: bool = True
    depth: int = at_least(0)


@dataclass
class TwoBranch(Predictor):
    _target_: str = target("memmlp.predictor.TwoBranch")


@dataclass
class RotationOnly(Predictor):
    _target_: str = target("memmlp.predictor.RotationOnly")


@dataclass
class TwoBranchMemory(Predictor):
    _target_: str = target("memmlp.predictor.TwoBranchMemory")
    depth: int = at_least(1)


@dataclass
class RotationOnlyMemory(Predictor):
    _target_: str = target("memmlp.predictor.RotationOnlyMemory")
    depth: int = at_least(1)


@dataclass
class Memory:
    _target_: str = MISSING
    _partial_: bool = True


@dataclass
class NoMemory(Memory):
    _target_: str = target("memmlp.memory.NoMemory")


@dataclass
class NoCodesMemory(Memory):
    _target_: str = target("memmlp.memory.NoCodesMemory")
    layers: list[int] = key(EachOf(Within(1)))
    width: int = at_least(1)
    shift: str = one_of("frame", "window")
    history: str = one_of("first", "latest")
    fusion: str = one_of("residual", "plain")
    blend: Union[int, float, str] = key(Within(0, 1, words=("sampled",)))


@dataclass
class CodeMemory(NoCodesMemory):
    _target_: str = target("memmlp.memory.CodeMemory")


@dataclass
class JointCodeMemory(NoCodesMemory):
    _target_: str = target("memmlp.memory.JointCodeMemory")


@dataclass
class RecurrentMemory(Memory):
    layers: list[int] = key(EachOf(Within(1)))
    width: int = at_least(1)
    fusion: str = one_of("residual", "plain")


@dataclass
class LSTMMemory(RecurrentMemory):
    _target_: str = target("memmlp.memory.LSTMMemory")


@dataclass
class GRUMemory(RecurrentMemory):
    _target_: str = target("memmlp.memory.GRUMemory")


@dataclass
class VQVAE:
    codes: int = at_least(1)
    width: int = at_least(1)
    encoder_depth: int = at_least(0)
    decoder_depth: int = at_least(0)
    commitment: float = at_least(0)
    decay: float = key(Within(0, 1, strict=True))
    codebook: str = one_of("ema", "gradient")
    steps: int = at_least(1)
    batch: int = at_least(1)
    lr: float = positive()
    weight_decay: float = at_least(0)


@dataclass
class Rollout:
    _target_: str = MISSING


@dataclass
class TeacherForcing(Rollout):
    _target_: str = target("memmlp.rollout.TeacherForcing")


@dataclass
class OwnPredictions(Rollout):
    _target_: str = target("memmlp.rollout.OwnPredictions")
    max_passes: int = at_least(1)


@dataclass
class Streams(Rollout):
    _target_: str = target("memmlp.rollout.PersistentStreams")
    streams: int = at_least(1)


@dataclass
class Loss:
    _target_: str = MISSING


@dataclass
class Uncertainty(Loss):
    _target_: str = target("memmlp.losses.Uncertainty")
    lr: float = positive()


@dataclass
class Manual(Loss):
    _target_: str = target("memmlp.losses.Manual")
    rotation: float = at_least(0)
    rotation_velocity: float = at_least(0)
    position: float = at_least(0)
    velocity: float = at_least(0)
    hand: float = at_least(0)


@dataclass
class ReferenceLoss(Loss):
    """A whole loss, where the others are weights of Mem-MLP's terms."""


@dataclass
class AGRoLLoss(ReferenceLoss):
    _target_: str = target("memmlp.losses.AGRoLLoss")


@dataclass
class AvatarPoserLoss(ReferenceLoss):
    _target_: str = target("memmlp.losses.AvatarPoserLoss")
    orientation: float = at_least(0)
    rotation: float = at_least(0)
    position: float = at_least(0)


@dataclass
class Hand:
    _target_: str = MISSING


@dataclass
class HandPosition(Hand):
    _target_: str = target("memmlp.losses.HandPosition")


@dataclass
class HandFK(Hand):
    _target_: str = target("memmlp.losses.HandFK")


@dataclass
class NoHand(Hand):
    _target_: str = target("memmlp.losses.NoHand")


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
class Tracker:
    _target_: str = MISSING


@dataclass
class MLflowTracker(Tracker):
    _target_: str = target("memmlp.tracking.MLflowTracker")
    uri: Optional[str] = key()


@dataclass
class NoTracker(Tracker):
    _target_: str = target("memmlp.tracking.NoTracker")


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
    tracker: Tracker = field(default_factory=Tracker)


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
    "tracker_mlflow": MLflowTracker,
    "tracker_none": NoTracker,
}


@functools.cache
def register() -> None:
    """Make the schemas known to Hydra."""
    for name, node in SCHEMAS.items():
        ConfigStore.instance().store(group="schema", name=name, node=node, provider="memmlp")


def check(cfg: DictConfig) -> None:
    """Refuse, naming the key, a missing value, one out of range, and an impossible combination."""
    if OmegaConf.get_type(cfg) is not Config:
        raise InputError(
            "the config does not start from the schema; its defaults list needs /schema/config@_here_"
        )
    for name, value, rule in _values(cfg, ""):
        if rule is not None and value is not None and not rule.allows(value):
            raise InputError(f"{name}={_show(value)}: allowed is {rule}")
    _check_combinations(cfg)


def _values(node: DictConfig, prefix: str) -> Iterator[tuple[str, Any, Any]]:
    """Dotted key, value and rule of every key of a typed node; a key that is not in the schema is refused."""
    schema: Any = OmegaConf.get_type(node)
    known = [spec.name for spec in dataclasses.fields(schema)]
    for extra in sorted(set(map(str, node)) - set(known)):
        raise InputError(unknown_key(prefix + extra, known))
    for spec in dataclasses.fields(schema):
        name = prefix + spec.name
        value = _value(node, spec.name, name)
        if isinstance(value, DictConfig):
            yield from _values(value, f"{name}.")
        else:
            yield name, value, spec.metadata.get("rule")


def unknown_key(name: str, keys: Sequence[str]) -> str:
    """The line about a dotted key that is not among a node's."""
    own = re.split(r"[./@]", name)[-1]
    near = difflib.get_close_matches(own, keys, n=1)
    hint = f"did you mean {near[0]}? " if near else ""
    listed = ", ".join(word for word in keys if not word.startswith("_")) or "none"
    return f"{name}: no such key; {hint}allowed here: {listed}"


def _value(node: DictConfig, own: str, name: str) -> Any:
    if OmegaConf.is_missing(node, own):
        raise InputError(f"{name}: has no value; give one with {name}=...")
    try:
        return node[own]
    except OmegaConfBaseException as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{name}: {reason}") from None


def _show(value: Any) -> str:
    """A value as it would be typed."""
    return str(list(value)) if OmegaConf.is_list(value) else str(value)


def _check_combinations(cfg: DictConfig) -> None:
    """What no key alone can tell."""
    if cfg.optim.final_lr > cfg.optim.lr:
        raise InputError(f"optim.final_lr={cfg.optim.final_lr}: allowed is at most optim.lr={cfg.optim.lr}")
    if _is(cfg.model, Reference):
        _check_reference(cfg)
    else:
        _check_slots(cfg)
    split = cfg.data.split
    held_out = split.val + (split.test if isinstance(split.get("test"), float) else 0)
    if held_out >= 1:
        raise InputError(f"data.split.val={split.val}: allowed is less than what data.split.test leaves of 1")


def _is(node: DictConfig, schema: type) -> bool:
    """Whether a group's option is of a schema."""
    kind = OmegaConf.get_type(node)
    return kind is not None and issubclass(kind, schema)


def _check_reference(cfg: DictConfig) -> None:
    """A network without slots, a history of its own or positions has nothing set that is about them."""
    name = cfg.model._target_.rsplit(".", 1)[-1]
    for group in ("memory", "predictor", "hand"):
        if cfg[group] is not None:
            raise InputError(f"{group}: {name} has none; allowed is a command line without {group}=...")
    if not _is(cfg.loss, ReferenceLoss):
        raise InputError(f"loss: weights of Mem-MLP's terms, which {name} has not; allowed is its own loss")
    if not _is(cfg.rollout, TeacherForcing):
        raise InputError(f"rollout: {name} has no history of its own; allowed is rollout=teacher_forcing")
    if cfg.evaluation.ik != "off":
        raise InputError(
            f"evaluation.ik={cfg.evaluation.ik} needs positions, and {name} has rotations alone: "
            "allowed is evaluation.ik=off"
        )
    if cfg.model.width % cfg.model.get("heads", 1):
        raise InputError(
            f"model.heads={cfg.model.heads}: allowed is a divisor of model.width={cfg.model.width}"
        )
    steps = cfg.model.get("diffusion_steps", 1)
    if cfg.model.get("sampling_steps", 1) > steps:
        raise InputError(
            f"model.sampling_steps={cfg.model.sampling_steps}: allowed is up to model.diffusion_steps={steps}"
        )


def _check_slots(cfg: DictConfig) -> None:
    """What stands in Mem-MLP's slots goes together."""
    layers = list(cfg.memory.get("layers", []))
    if layers and max(layers) > cfg.model.depth:
        raise InputError(f"memory.layers={layers}: allowed is up to model.depth={cfg.model.depth}")
    if _is(cfg.loss, ReferenceLoss):
        raise InputError("loss: that of a reference network; allowed is loss=uncertainty or loss=manual")
    predictor = cfg.predictor._target_.rsplit(".", 1)[-1]
    if cfg.hand._target_.endswith("HandPosition") and predictor.startswith("RotationOnly"):
        raise InputError(
            "hand=position needs the positions of predictor=two_branch: allowed is hand=fk or hand=off"
        )
    if predictor.endswith("Memory") and not layers:
        raise InputError(
            "predictor with memory blocks needs a memory, and memory=none is none: "
            "allowed is another memory, predictor=two_branch or predictor=rotation_only"
        )
    if cfg.evaluation.ik != "off" and predictor.startswith("RotationOnly"):
        raise InputError(
            f"evaluation.ik={cfg.evaluation.ik} needs the positions of predictor=two_branch: "
            "allowed is evaluation.ik=off"
        )
    if "streams" in cfg.rollout and cfg.rollout.streams < cfg.optim.batch:
        raise InputError(
            f"rollout.streams={cfg.rollout.streams}: allowed is at least optim.batch={cfg.optim.batch}"
        )
