"""Ids: a hash of everything that affects the result of a stage.

A **run** is the training of a network or of a VQ-VAE. Its id is a hash of its config, its data, the id of its
prerequisite run, and its component versions. An **evaluation** has one mode, with or without inverse
kinematics. A **deployment** has ONNX files and their latencies. Their own ids depend only on settings that
can change their own result, so a new mode or precision repeats only its stage. A component is identified by
its name in the config, never by the path of its class."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from memmlp.common.components import SLOTS, collect_components
from memmlp.common.files import make_json_safe
from memmlp.common.overrides import flatten

VERSIONS: dict[str, int] = {
    # the inputs of networks (memmlp.motion)
    "features": 1,
    # network parts that are not an option of a slot
    "vqvae": 1,
    "codebook.ema": 1,
    "codebook.gradient": 1,
    # training (memmlp.training)
    "sampler": 1,
    "mirror": 2,
    "training": 1,
    "schedule.step": 1,
    "schedule.cosine": 1,
    "schedule.milestones": 1,
    "ema": 1,
    "compute": 1,
    "warmup": 1,
    "precision.bf16": 2,
    "weighting.learned": 2,
    # evaluation (memmlp.evaluation)
    "metrics": 1,
    "mode.stream": 1,
    "mode.window": 3,
    "ik.lbfgs": 1,
    "ik.arms": 1,
    # deployment (memmlp.deploy)
    "export": 1,
    "graph.streaming": 1,
    "graph.naive": 1,
    "int8": 4,
    "fp16": 3,
    "latency": 1,
}
"""The versions of components that are not an option of a slot."""


def find_version(component: str) -> int:
    """Return the version of a component by name, SLOT.NAME or a key of VERSIONS; 0 if it is not in use."""
    slot, _, name = component.partition(".")
    declaration = collect_components().get((slot, name))
    return VERSIONS.get(component, declaration.version if declaration else 0)


def find_versions(components: Iterable[str]) -> dict[str, int]:
    """Return the versions of components, by name; 0 for a component that is not in use."""
    return {name: find_version(name) for name in sorted(components)}


def list_outdated(recorded: Mapping[str, int]) -> list[str]:
    """Describe each recorded component version that differs from the current version: "name old -> new"."""
    now = find_versions(recorded)
    return [f"{name} {number} -> {now[name]}" for name, number in recorded.items() if now[name] != number]


NEUTRAL = (
    "data",  # replaced by the data's digest (frames, clips, split and rest pose), except for DRAWS
    "profile",  # the groups that use its sizes count
    "paths",
    "loggers",
    "device",  # recorded; tables flag different devices
    "threads",
    "force",
    "plugins",  # packages in use; the config names their components
    "save_predictions",
    "optim.checkpoint_every",
    "optim.log_every",
    "optim.validate_every",
    "optim.validation_pieces",
    "hydra",
)
"""Config keys that do not change results of any stage."""

STAGE_GROUPS = ("evaluation", "export")
INFERENCE = ("memory.blend", "memory.history", "model.sampling_steps", "model.offline")
"""Config keys of evaluations and deployments. INFERENCE keys also count for training with rollouts."""

NETWORK = "memmlp"
"""The kind of motion network runs, including baselines; all other kinds are prerequisite runs."""

ID = re.compile(r"[0-9a-f]{16}")
"""The pattern of run ids."""

DATA_PATH = re.compile(r"data\.(root|body|split\.folder|sources\..+\.root)")
"""The config keys with paths of data."""

DRAWS = re.compile(r"data\.(drawn_by|mirror|sources\..+\.weight)")
"""The config keys for drawing training windows; the data's digest does not cover them."""

GROUPS = re.compile(r"data\.(split|sources\..+?)\.(groups|persons)(\..*)?")
"""The config keys of clip groups. They count for training with data.drawn_by=groups."""

VQVAE_SHAPE = ("codes", "width", "encoder_depth", "decoder_depth", "commitment", "decay", "codebook")
"""The VQ-VAE keys that count if it is trained with the network; other keys concern separate training."""

EXPORTED = {"graph": "auto", "precision": "fp32", "opset": 18}
"""The keys of `export` that determine the exported file, with their defaults."""


@dataclass(frozen=True)
class Identity:
    """The identity of a run: its `kind` (NETWORK, "vqvae" or the name of the trained part), resolved
    `config`, digest of the prepared `data`, and the run that provides its weights."""

    kind: str
    config: Mapping[str, Any]
    data: str
    prerequisite: Identity | None = None

    @property
    def component_versions(self) -> dict[str, int]:
        """The versions of all components that the training uses, by name."""
        return find_versions(list_components(self.kind, self.config))

    @property
    def id(self) -> str:
        """A hash of everything that affects the result, 16 hex digits."""
        content = {
            "kind": self.kind,
            "config": select_training_config(self.config),
            "data": self.data,
            "prerequisite": self.prerequisite.id if self.prerequisite else None,
            "component_versions": self.component_versions,
        }
        return _digest(content)


def compute_evaluation_id(config: Mapping[str, Any], mode: str, groups_digest: str | None = None) -> str:
    """Return the id of a run's evaluation in a mode: mode, inverse kinematics and 16 hex digits."""
    return hash_evaluation_settings(select_evaluation_settings(config, mode, groups_digest))


def hash_evaluation_settings(settings: Mapping[str, Any]) -> str:
    """Return the id of an evaluation with these settings and the current component versions."""
    mode, ik = settings["mode"], settings["ik"]
    versions = find_evaluation_versions(settings)
    return _hash_settings(mode if ik == "off" else f"{mode}-{ik}", settings, versions)


def _hash_settings(name: str, settings: Mapping[str, Any], versions: Mapping[str, int]) -> str:
    return f"{name}-{_digest({'settings': settings, 'component_versions': versions})}"


def find_evaluation_versions(settings: Mapping[str, Any]) -> dict[str, int]:
    """Return the versions of all components that an evaluation uses, by name."""
    solver = [f"ik.{settings['ik']}"] if settings["ik"] != "off" else []
    own = [f"metric.{name}" for name in settings.get("metrics", ())]
    return find_versions(["metrics", f"mode.{settings['mode']}", *solver, *own])


def select_evaluation_settings(
    config: Mapping[str, Any], mode: str, groups_digest: str | None = None
) -> dict[str, Any]:
    """Return the settings that determine an evaluation's result, in addition to the run and its data.
    `groups_digest` is the digest of the file with the clip groups (`data.split.groups_file`)."""
    chosen = config.get("evaluation", {})
    ik = chosen.get("ik", "off")
    solver = {"ik": ik} | ({"ik_iterations": chosen.get("ik_iterations")} if ik == "lbfgs" else {})
    data = config.get("data") or {}
    sources = (data.get("sources") or {}).items()
    groups = {
        "groups": (data.get("split") or {}).get("groups"),  # patterns of clip groups
        "source_groups": {name: own for name, source in sources if (own := source.get("groups"))},
        "groups_file": groups_digest,
    }
    inference = select_inference_config(config)
    drawn = {"batch": chosen.get("batch")} if inference.get("memory.blend") == "sampled" else {}
    names = sorted(chosen.get("metrics") or ())
    custom = {name: collect_components().get(("metric", name)) for name in names}
    metrics = {name: f"{one.module}.{one.builds}" if one else "" for name, one in custom.items()}
    further = {**groups, "metrics": metrics, "metric_set": chosen.get("metric_set")}
    further = {key: value for key, value in further.items() if value}
    return {"mode": mode, **solver, **inference, **drawn, **further}


def get_solver_name(settings: Mapping[str, Any]) -> str | None:
    """Return the name of the inverse kinematics, such as "arms" or "lbfgs-15", or None."""
    ik, iterations = settings.get("ik", "off"), settings.get("ik_iterations")
    if ik in (None, "off"):
        return None
    return f"{ik}-{iterations}" if ik == "lbfgs" and iterations else str(ik)


def compute_deployment_id(config: Mapping[str, Any]) -> str:
    """Return the id of a run's deployment: precision and 16 hex digits."""
    return hash_deployment_settings(select_deployment_settings(config))


def hash_deployment_settings(settings: Mapping[str, Any]) -> str:
    """Return the id of a deployment with these settings and the current component versions."""
    return _hash_settings(settings.get("precision", "fp32"), settings, find_deployment_versions(settings))


def find_deployment_versions(settings: Mapping[str, Any]) -> dict[str, int]:
    """Return the versions of all components that a deployment uses, by name."""
    graph, name = settings.get("graph", "auto"), settings.get("precision", "fp32")
    graphs = [f"graph.{one}" for one in ("streaming", "naive") if graph in (one, "auto")]
    return find_versions(["export", "latency", *graphs, *([name] if name != "fp32" else [])])


def select_deployment_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that determine a deployment's result, in addition to the run and its data."""
    own = {key: _normalize_numbers(value) for key, value in config.get("export", {}).items()}
    return own | select_inference_config(config)


def list_components(kind: str, config: Mapping[str, Any]) -> Iterable[str]:
    """Yield the names of all components that affect the numbers of a training."""
    yield from ("features", "sampler", "training")
    if (config.get("data") or {}).get("mirror"):
        yield "mirror"
    if coordinates := config.get("normalizer", {}).get("coordinates"):
        yield f"coordinates.{coordinates}"
    yield from (f"{slot}.{name}" for slot in SLOTS if (name := find_option(config, slot)))
    if (config.get("loss") or {}).get("weighting") == "learned":
        yield "weighting.learned"
    optim = config.get("optim", {})
    if schedule := optim.get("schedule"):
        yield f"schedule.{schedule}"
    yield from (name for name in ("warmup", "ema") if optim.get(name))
    part = (config.get("prerequisite") or {}).get(kind) or {}
    if optim.get("tflop") or part.get("tflop"):
        yield "compute"
    if optim.get("precision") == "bf16":
        yield "precision.bf16"
    if kind == "vqvae" or find_option(config, "memory") == "vq_joint":
        yield from ("vqvae", f"codebook.{config.get('vqvae', {}).get('codebook')}")
    if kind == "vqvae":
        yield "schedule.milestones"


def find_training_settings(kind: str, config: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the config group with the number of training steps for a kind of run."""
    if kind == "vqvae":
        return config["vqvae"]
    return config["optim"] if kind == NETWORK else config["prerequisite"][kind]


def find_option(config: Mapping[str, Any], slot: str) -> str | None:
    """Return the name of the option in a slot; None if the slot is empty."""
    return (config.get(slot) or {}).get("name")


def select_training_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config values that can change a training's result, by dotted key, without null values."""
    rollout = find_option(config, "rollout") or "teacher_forcing"
    as_live = config.get("refiner") or config.get("prerequisite") or rollout != "teacher_forcing"
    out = (*NEUTRAL, *STAGE_GROUPS, *(() if as_live else INFERENCE))
    flat = {key: value for key, value in flatten(config).items() if value is not None}
    counting = [key for key in flat if DRAWS.fullmatch(key) or not _is_below(key, out)]
    if flat.get("data.drawn_by") == "groups":
        counting += [key for key in flat if GROUPS.fullmatch(key)]
    if "optim.tflop" in counting:  # it sets the number of steps
        counting.remove("optim.steps")
    if "optim.best_by" in counting:
        counting += [key for key in ("optim.validate_every", "optim.validation_pieces") if key in flat]
    return {key: _normalize_numbers(flat[key]) for key in counting}


def affects_training(key: str, config: Mapping[str, Any]) -> bool:
    """Return whether a dotted key of this config can change the training or the data."""
    if key.startswith(("data.", "profile.")):  # the profile's keys act through other groups
        return True
    return any(_is_below(name, [key]) for name in select_training_config(config))


def select_validation_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config values that determine the validation clips of a training, by dotted key."""
    flat = flatten({"data": config.get("data") or {}})
    drawn = {key for key in flat if DRAWS.fullmatch(key) or key == "data.split.train_fraction"}
    return {key: _normalize_numbers(value) for key, value in flat.items() if key not in drawn}


def is_data_path(key: str) -> bool:
    """Return whether a dotted key is a path of data; paths don't count, since data has a digest."""
    return DATA_PATH.fullmatch(key) is not None


def belongs_to_folder(run_id: str | None, folder: Path) -> bool:
    """Return whether a file that records a run id is in the folder of that run. A folder that is not named by
    an id is a copy of a run; all its files belong to it."""
    return run_id in (None, folder.name) or not ID.fullmatch(folder.name)


def has_configured_inference(settings: Mapping[str, Any], config: Mapping[str, Any]) -> bool:
    """Return whether a stage's settings have the same INFERENCE values as the run's config."""
    return all(settings.get(key) == value for key, value in select_inference_config(config).items())


def describe_export_difference(settings: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the export settings in which a deployment differs from the run's config, such as "naive-int8",
    or "". `export.graph=off` in the config counts as the default graph."""
    export = config.get("export") or {}
    own = {**export, "graph": "auto"} if export.get("graph") in ("off", False) else export
    exported = {key: settings.get(key, default) for key, default in EXPORTED.items()}
    other = {key: value for key, value in exported.items() if value != own.get(key, EXPORTED[key])}
    return "-".join(f"opset{value}" if key == "opset" else str(value) for key, value in other.items())


def select_inference_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the INFERENCE values of a config, by dotted key."""
    flat = flatten(config)
    return {key: _normalize_numbers(flat[key]) for key in INFERENCE if key in flat}


def _is_below(key: str, names: Iterable[str]) -> bool:
    return any(key == name or key.startswith(f"{name}.") for name in names)


def _digest(content: Mapping[str, Any]) -> str:
    text = json.dumps(make_json_safe(content), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _normalize_numbers(value: Any) -> Any:
    """Convert floats that are whole numbers to int, so that 1.0 and 1 have the same hash."""
    if isinstance(value, list | tuple):
        return [_normalize_numbers(item) for item in value]
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value
