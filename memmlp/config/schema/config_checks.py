"""Checks of a composed config before anything runs; each error is one line that names the key."""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Iterator, Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from memmlp.common.errors import InputError
from memmlp.config.schema.config import SCHEMAS, Config
from memmlp.config.schema.network import (
    AvatarJLMConfig,
    AvatarPoserConfig,
    BaselineConfig,
    BoDiffusionConfig,
    EgoPoserConfig,
    ManikinSConfig,
    NoMemoryConfig,
    RecurrentPoserConfig,
    RPMConfig,
    SAGEConfig,
)
from memmlp.config.schema.training import (
    AGRoLLossConfig,
    BaselineLossConfig,
    LossOfNetworkConfig,
    NoHandConfig,
    OwnPredictionsConfig,
    StreamsConfig,
    TeacherForcingConfig,
    TermsLossConfig,
)
from memmlp.runs.former_keys import present_key
from memmlp.runs.identity import SLOTS

WITHOUT_STREAM = ("naive", "off")
"""The values of `export.graph` with which no streaming graph is exported."""

TERM_FRAMES = {
    "sixd_velocity": 2, "turn": 2, "velocity": 2, "velocity_3": 4, "velocity_5": 6, "acceleration": 3,
    "jerk": 4, "contact": 2, "foot_height": 2,
}  # fmt: skip
"""The loss terms that need several frames (memmlp.training.losses.terms.TERMS, without importing torch)."""

NEWEST_ALONE = (AvatarPoserConfig, EgoPoserConfig, ManikinSConfig, SAGEConfig)
"""The networks that learn the newest frame of a window alone; subclasses are others."""


def check(cfg: DictConfig) -> None:
    """Check a composed config.

    Raises:
        InputError: for a missing or unknown key, a value that its rule refuses, or values that don't go
            together; the message names the key.
    """
    if OmegaConf.get_type(cfg) is not Config:
        raise InputError(
            "the config does not start from the schema; its defaults list needs /schema/config@_here_"
        )
    for name, value, rule in _values(cfg, ""):
        if rule is not None and value is not None and not rule.allows(value):
            raise InputError(f"{name}={_show(value)}: allowed is {rule}")
    _check_combinations(cfg)


def _values(node: DictConfig, prefix: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield the dotted name, value and rule of every key below a typed node.

    Raises:
        InputError: for a key that is not in the schema.
    """
    schema: Any = OmegaConf.get_type(node)
    if not dataclasses.is_dataclass(schema):  # a dictionary of groups
        for name in map(str, node):
            yield from _values(node[name], f"{prefix}{name}.")
        return
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
    """Return the error line for a dotted key that is not among the keys of its group."""
    own = re.split(r"[./@]", name)[-1]
    near = difflib.get_close_matches(own, keys, n=1)
    hint = f"did you mean {near[0]}? " if near else ""
    if (now := present_key(name.replace("@", "."), keys)) is not None:
        hint = f"it is now {now}; "
    fixed = ("name",) if "_target_" in keys else ()  # tells which option of a slot it is
    listed = ", ".join(word for word in keys if not word.startswith("_") and word not in fixed) or "none"
    return f"{name}: no such key; {hint}allowed here: {listed}"


def _value(node: DictConfig, own: str, name: str) -> Any:
    """Return a key's value. Raises InputError if it is missing or can't be resolved."""
    if OmegaConf.is_missing(node, own):
        raise InputError(f"{name}: has no value; give one with {name}=...")
    try:
        return node[own]
    except OmegaConfBaseException as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{name}: {reason}") from None


def _show(value: Any) -> str:
    """Return a value as a user would type it."""
    return str(list(value)) if OmegaConf.is_list(value) else str(value)


def _check_names(cfg: DictConfig) -> None:
    """Raise InputError for a foreign component that uses the name of one of this package's options."""
    for slot in SLOTS:
        node = cfg[slot]
        path = node.get("_target_") if node is not None else None
        schema = SCHEMAS.get(f"{slot}_{node.name}") if path else None
        ours = schema is not None and schema.__module__.startswith("memmlp.")
        if path and ours and not path.startswith("memmlp."):
            raise InputError(f"{slot}.name={node.name}: allowed for {path} is a name of its own")
    for name, node in cfg.loggers.items():
        if node.name != name:
            raise InputError(f"loggers.{name}.name={node.name}: allowed is {name}, the logger's key")


def _check_combinations(cfg: DictConfig) -> None:
    """Check what concerns several keys: whether their values go together."""
    _check_names(cfg)
    if "final_lr" in cfg.optim and cfg.optim.final_lr > cfg.optim.lr:
        raise InputError(f"optim.final_lr={cfg.optim.final_lr}: allowed is at most optim.lr={cfg.optim.lr}")
    if cfg.optim.warmup > cfg.optim.steps:
        raise InputError(f"optim.warmup={cfg.optim.warmup}: allowed is at most optim.steps={cfg.optim.steps}")
    if (cfg.upstream is not None) != _is(cfg.model, SAGEConfig):
        needed = "upstream=sage" if cfg.upstream is None else "upstream=null"
        raise InputError(f"upstream: of the parts of SAGE-Net; allowed with this model is {needed}")
    if _is(cfg.model, BaselineConfig):
        _check_baseline(cfg)
    else:
        _check_slots(cfg)
    _check_terms(cfg)
    if "streams" in cfg.rollout and cfg.rollout.streams < cfg.optim.batch:
        raise InputError(
            f"rollout.streams={cfg.rollout.streams}: allowed is at least optim.batch={cfg.optim.batch}"
        )
    if (cfg.vqvae.epochs is None) == (cfg.vqvae.steps is None):
        given = f"vqvae.epochs={cfg.vqvae.epochs}, vqvae.steps={cfg.vqvae.steps}"
        raise InputError(f"{given}: allowed is one of them, and null for the other")
    _check_sources(cfg.data)
    _check_export(cfg)
    split = cfg.data.split
    held_out = split.val + (split.test if isinstance(split.get("test"), float) else 0)
    if held_out >= 1:
        raise InputError(f"data.split.val={split.val}: allowed is less than what data.split.test leaves of 1")


def _check_sources(data: DictConfig) -> None:
    """Check that the data is one folder, a list of folders, or named sources."""
    sources = data.get("sources") or {}
    if (data.root is None) == (not sources):
        raise InputError(
            f"data.root={data.root}: allowed is a folder or a list of them, or null with data.sources"
        )
    if bad := [name for name in map(str, sources) if not re.fullmatch(r"[\w-]+", name)]:
        raise InputError(f"data.sources.{bad[0]}: allowed in a name are letters, digits, - and _")
    weights = [source.weight for source in sources.values()]
    if any(weights) and not all(weights):
        raise InputError("data.sources: allowed is a weight for each source or for none")
    if (sources or OmegaConf.is_list(data.root)) and data.split.groups_file is not None:
        raise InputError(
            "data.split.groups_file: allowed for one folder; a source has data.sources.NAME.groups_file"
        )


def _check_export(cfg: DictConfig) -> None:
    """Check that a file with lower precision has the streaming graph from which it is made."""
    precision = f"export.precision={cfg.export.precision}: is made of the streaming graph, and"
    if cfg.export.precision != "fp32" and cfg.export.graph in WITHOUT_STREAM:
        raise InputError(
            f"{precision} export.graph={cfg.export.graph} has none: allowed is auto or streaming"
        )
    if cfg.export.precision != "fp32" and cfg.memory is not None and cfg.memory.get("history") == "latest":
        raise InputError(f"{precision} memory.history=latest has none: allowed is memory.history=first")


def _is(node: DictConfig, schema: type) -> bool:
    """Return whether a group's option has this schema."""
    kind = OmegaConf.get_type(node)
    return kind is not None and issubclass(kind, schema)


def _check_baseline(cfg: DictConfig) -> None:
    """Check the config of a baseline, which has no slots, no history of its own and no positions.

    No key for these may be set, and the network's sizes must fit each other.
    """
    name = cfg.model._target_.rsplit(".", 1)[-1]
    for group in ("memory", "predictor", "hand", "term"):
        if cfg[group] is not None:
            raise InputError(f"{group}: {name} has none; allowed is a command line without {group}=...")
    if _is(cfg.loss, LossOfNetworkConfig) and not _is(cfg.model, BoDiffusionConfig):
        raise InputError(f"loss=of_network: {name} has none to be trained with; allowed is another loss")
    if not _is(cfg.loss, BaselineLossConfig):
        raise InputError(f"loss: weights of Mem-MLP's terms, which {name} has not; allowed is its own loss")
    carries = _is(cfg.model, RecurrentPoserConfig) and _is(cfg.rollout, StreamsConfig)
    if not (_is(cfg.rollout, TeacherForcingConfig) or carries):
        raise InputError(f"rollout: {name} has no history of its own; allowed is rollout=teacher_forcing")
    if cfg.evaluation.ik == "lbfgs":
        raise InputError(
            f"evaluation.ik=lbfgs needs positions, and {name} has rotations alone: allowed is off or arms"
        )
    reaching = cfg.model.get("output") == "reaching" and cfg.refiner is None  # a refiner moves arms again
    if cfg.evaluation.ik == "arms" and reaching:
        raise InputError("evaluation.ik=arms: model.output=reaching has such arms already; allowed is off")
    if _is(cfg.model, SAGEConfig) and cfg.model.frames % 2:
        # Its codes are of two frames each: the decoder would make a frame less than the window has.
        raise InputError(f"model.frames={cfg.model.frames}: allowed for {name} is an even number")
    for heads, width in (("heads", "width"), ("code_heads", "code_width")):
        if heads in cfg.model and cfg.model[width] % cfg.model[heads]:
            raise InputError(
                f"model.{heads}={cfg.model[heads]}: allowed is a divisor of model.{width}={cfg.model[width]}"
            )
    if _is(cfg.model, SAGEConfig) and cfg.model.code_width % 2:
        raise InputError(f"model.code_width={cfg.model.code_width}: allowed with SAGENet is an even number")
    if _is(cfg.model, AvatarJLMConfig) and cfg.model.width % 4:
        raise InputError(f"model.width={cfg.model.width}: allowed with AvatarJLM is a multiple of 4")
    if _is(cfg.model, RPMConfig) and cfg.model.frames < (least := cfg.model.context + cfg.model.horizon):
        raise InputError(
            f"model.frames={cfg.model.frames}: allowed is at least model.context + model.horizon = {least}"
        )
    if cfg.model.get("offline") and (list(cfg.evaluation.modes) != ["window"] or cfg.export.graph != "off"):
        raise InputError(
            "model.offline=true: a frame is made with later ones, so there is no stream: "
            "allowed is evaluation.modes=[window] with export.graph=off"
        )
    if cfg.model.get("offline") and cfg.refiner is not None:
        raise InputError("refiner: corrects a stream, which model.offline=true is not; allowed is null")
    if _is(cfg.model, EgoPoserConfig) and cfg.normalizer.z_scores and cfg.normalizer.coordinates == "world":
        raise InputError(
            "normalizer.z_scores=true: EgoPoser takes the head's place off the hands', which is no sense of "
            "z-scores in the world; allowed is normalizer.z_scores=false, or normalizer.coordinates=heading"
        )
    steps = cfg.model.get("diffusion_steps", 1)
    if cfg.model.get("sampling_steps", 1) > steps:
        raise InputError(
            f"model.sampling_steps={cfg.model.sampling_steps}: allowed is up to model.diffusion_steps={steps}"
        )
    if _is(cfg.loss, LossOfNetworkConfig) and not cfg.model.noise_weight:
        raise InputError("model.noise_weight=0: allowed with loss=of_network is above 0, or another loss")


def _check_foreign_loss(cfg: DictConfig, predictor: str) -> None:
    """Raise InputError for the loss of a baseline with Mem-MLP, with two exceptions.

    AGRoL's loss and the library's terms score rotations alone, so a Mem-MLP that predicts nothing else may be
    trained with them.
    """
    if not _is(cfg.loss, AGRoLLossConfig) and not _is(cfg.loss, TermsLossConfig):
        raise InputError(
            f"loss={cfg.loss.name}: a baseline's, of other outputs than Mem-MLP's; allowed are "
            "loss=uncertainty and loss=manual, or with predictor=rotation_only hand=off loss=agrol and the "
            "library's terms"
        )
    if not predictor.startswith("RotationOnly") or not _is(cfg.hand, NoHandConfig):
        raise InputError(
            f"loss={cfg.loss.name} is of rotations alone: allowed is predictor=rotation_only with hand=off, "
            "or loss=uncertainty or loss=manual"
        )


def _check_terms(cfg: DictConfig) -> None:
    """Raise InputError for a term of the loss that needs more frames than the network learns of a window."""
    if not _is(cfg.loss, TermsLossConfig):
        return
    frames = 1 if OmegaConf.get_type(cfg.model) in NEWEST_ALONE else cfg.model.frames
    for name, needed in TERM_FRAMES.items():
        if cfg.loss.get(name) is not None and frames < needed:
            raise InputError(
                f"loss.{name}: needs {needed} frames of each window, and this network learns {frames}; "
                f"allowed is loss.{name}=null"
            )


def _check_slots(cfg: DictConfig) -> None:
    """Check that Mem-MLP's slots are filled, and that the options in them go together."""
    for slot, none in (("memory", "memory=none"), ("predictor", None), ("hand", "hand=off")):
        if cfg[slot] is None:
            allowed = f"{none} for none" if none else "one of its options"
            raise InputError(f"{slot}: nothing is in this slot of model=mem_mlp; allowed is {allowed}")
    layers = list(cfg.memory.get("layers", []))
    if layers and max(layers) > cfg.model.depth:
        raise InputError(f"memory.layers={layers}: allowed is up to model.depth={cfg.model.depth}")
    predictor = cfg.predictor._target_.rsplit(".", 1)[-1]
    if _is(cfg.loss, BaselineLossConfig):
        _check_foreign_loss(cfg, predictor)
    if cfg.hand._target_.endswith("HandPosition") and predictor.startswith("RotationOnly"):
        raise InputError(
            "hand=position needs the positions of predictor=two_branch: allowed is hand=fk or hand=off"
        )
    if predictor.endswith("Memory") and not layers:
        raise InputError(
            "predictor with memory blocks needs a memory, and memory=none is none: "
            "allowed is another memory, predictor=two_branch or predictor=rotation_only"
        )
    if _is(cfg.memory, NoMemoryConfig) and _is(cfg.rollout, OwnPredictionsConfig):
        raise InputError(
            "rollout=own_predictions makes the past that a memory recalls, and memory=none recalls none: "
            "allowed is another memory, rollout=teacher_forcing or rollout=streams"
        )
    passes, frames = cfg.rollout.get("max_passes", cfg.model.frames), cfg.model.frames
    if cfg.memory.get("shift") == "frame" and passes < frames:
        raise InputError(
            f"rollout.max_passes={passes}: a call makes one frame of the past with memory.shift=frame, which "
            f"has {frames}: allowed is at least model.frames={frames}, memory.shift=window or rollout=streams"
        )
    if cfg.evaluation.ik == "lbfgs" and predictor.startswith("RotationOnly"):
        raise InputError(
            "evaluation.ik=lbfgs needs the positions of predictor=two_branch: allowed is off or arms"
        )
