"""Ids: hashes of everything that affects a result, one for each stage that makes results.

A **run** is a training (of a VQ-VAE or of a network). Its id is a hash of its config, its data, the id of its
prerequisite run, and the component versions that it uses. An **evaluation** of it (one mode, with or without
inverse kinematics) and a **deployment** (ONNX, int8, latency) have ids of their own, made only from what can
change their own result. So a new mode, inverse kinematics or precision on a finished run repeats only that
stage, not the training. A component is identified by its name in the config, never by the path of its class.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from memmlp.common.components import SLOTS, declared
from memmlp.common.files import plain

VERSIONS: dict[str, int] = {
    # what networks see (memmlp.motion)
    "features": 1,
    # parts of networks that are not an option of a slot
    "vqvae": 1,
    "codebook.ema": 1,
    "codebook.gradient": 1,
    # how they are trained (memmlp.training)
    "sampler": 1,
    "mirror": 2,
    "training": 1,
    "schedule.step": 1,
    "schedule.cosine": 1,
    "schedule.milestones": 1,
    "ema": 1,
    "warmup": 1,
    "precision.bf16": 2,
    "weighting.learned": 2,
    # how they are evaluated (memmlp.evaluation)
    "metrics": 1,
    "mode.stream": 1,
    "mode.window": 3,
    "ik.lbfgs": 1,
    "ik.arms": 1,
    # how they are deployed (memmlp.deploy)
    "export": 1,
    "graph.streaming": 1,
    "graph.naive": 1,
    "int8": 3,
    "int8_blocks": 3,
    "fp16": 3,
    "latency": 1,
}
"""The versions of parts that are not an option of a slot."""


def version_of(component: str) -> int:
    """Return the version of a component, named SLOT.NAME or as in VERSIONS; 0 if it is not in use."""
    slot, _, name = component.partition(".")
    found = declared().get((slot, name))
    return VERSIONS.get(component, found.version if found else 0)


def find_versions(components: Iterable[str]) -> dict[str, int]:
    """Return the versions of components by name; 0 for a component that is not in use."""
    return {name: version_of(name) for name in sorted(components)}


def outdated(recorded: Mapping[str, int]) -> list[str]:
    """Describe the recorded component versions that differ from the current ones: "name old -> new"."""
    now = find_versions(recorded)
    return [f"{name} {number} -> {now[name]}" for name, number in recorded.items() if now[name] != number]


NEUTRAL = (
    "data",  # its digest stands for it: frames, clips, split and rest pose; but see DRAWS
    "profile",  # sizes, read by the groups that use them
    "paths",
    "loggers",
    "device",  # recorded, and flagged where runs that are compared differ in it
    "threads",
    "force",
    "plugins",  # the packages in use; their components are named in the config
    "save_predictions",
    "optim.checkpoint_every",
    "optim.log_every",
    "optim.validate_every",
    "hydra",
)
"""Config keys that change no result of any stage."""

EVALUATION = ("evaluation",)
DEPLOYMENT = ("export",)
INFERENCE = ("memory.blend", "memory.history", "model.sampling_steps", "model.offline")
"""Keys of the later stages; those of INFERENCE count for both, and for a training that rolls out."""

NETWORK = "memmlp"
"""The kind of the runs of motion networks, of baselines too; all other kinds are prerequisite of these."""

ID = re.compile(r"[0-9a-f]{16}")
"""What the id of a run looks like."""

DATA_PATH = re.compile(r"data\.(root|body|split\.folder|sources\..+\.root)")
"""The keys that say where data lies."""

DRAWS = re.compile(r"data\.(drawn_by|mirror|sources\..+\.weight)")
"""The keys that say how training windows are drawn, which the data's digest does not cover."""

VQVAE_SHAPE = ("codes", "width", "encoder_depth", "decoder_depth", "commitment", "decay", "codebook")
"""The keys of a VQ-VAE that count if it is trained with the network; the others are of its own training."""

EXPORTED = {"graph": "auto", "precision": "fp32", "opset": 18}
"""The keys of `export` that decide which file is made, with what they are where they are missing."""


@dataclass(frozen=True)
class Identity:
    """The identity of a run.

    Attributes:
        kind: NETWORK for every motion network, including baselines; for a prerequisite run, "vqvae" or the
            name of the part that is trained.
        config: the resolved config. Keys that are neutral or belong to a later stage are ignored, and 1
            equals 1.0.
        data: digest of the prepared data.
        prerequisite: the identity of the run whose weights this one uses.
    """

    kind: str
    config: Mapping[str, Any]
    data: str
    prerequisite: Identity | None = None

    @property
    def component_versions(self) -> dict[str, int]:
        """The versions of the components that the training uses."""
        return find_versions(list_components(self.kind, self.config))

    @property
    def id(self) -> str:
        """A hash of everything that affects the result, 16 hex digits."""
        content = {
            "kind": self.kind,
            "config": training_config(self.config),
            "data": self.data,
            "prerequisite": self.prerequisite.id if self.prerequisite else None,
            "component_versions": self.component_versions,
        }
        return _digest(content)


def evaluation_id(config: Mapping[str, Any], mode: str, groups_digest: str | None = None) -> str:
    """Return the identity of a run's evaluation in a mode: a word and 16 hex digits."""
    return evaluation_id_of(evaluation_settings(config, mode, groups_digest))


def evaluation_id_of(settings: Mapping[str, Any]) -> str:
    """Return the identity of an evaluation with these settings, with the present component versions."""
    mode, ik = settings["mode"], settings["ik"]
    name = mode if ik == "off" else f"{mode}-{ik}"
    return f"{name}-{_digest({'settings': settings, 'component_versions': evaluation_versions(settings)})}"


def evaluation_versions(settings: Mapping[str, Any]) -> dict[str, int]:
    """Return the component versions of the components that an evaluation uses."""
    solver = [f"ik.{settings['ik']}"] if settings["ik"] != "off" else []
    own = [f"metric.{name}" for name in settings.get("metrics", ())]
    return find_versions(["metrics", f"mode.{settings['mode']}", *solver, *own])


def evaluation_settings(
    config: Mapping[str, Any], mode: str, groups_digest: str | None = None
) -> dict[str, Any]:
    """Return the settings that determine an evaluation's result, besides the run and its data.

    `groups_digest` is a digest of the column file that says which clips belong together; None without a file.
    """
    chosen = config.get("evaluation", {})
    ik = chosen.get("ik", "off")
    solver = {"ik": ik} | ({"ik_iterations": chosen.get("ik_iterations")} if ik == "lbfgs" else {})
    data = config.get("data") or {}
    sources = (data.get("sources") or {}).items()
    groups = {
        "groups": (data.get("split") or {}).get("groups"),  # patterns of clips that belong together
        "source_groups": {name: own for name, source in sources if (own := source.get("groups"))},
        "groups_file": groups_digest,
    }
    drawn = {"batch": chosen.get("batch")} if inference(config).get("memory.blend") == "sampled" else {}
    custom = {name: declared().get(("metric", name)) for name in sorted(chosen.get("metrics") or ())}
    metrics = {name: f"{one.module}.{one.builds}" if one else "" for name, one in custom.items()}
    further = {key: value for key, value in {**groups, "metrics": metrics}.items() if value}
    return {"mode": mode, **solver, **inference(config), **drawn, **further}


def solver_of(settings: Mapping[str, Any]) -> str | None:
    """Return which inverse kinematics an evaluation's settings or a config's `evaluation` name.

    L-BFGS has its iterations with it ("lbfgs-15"). None is returned for none, or if it is not known.
    """
    ik, iterations = settings.get("ik", "off"), settings.get("ik_iterations")
    if ik in (None, "off"):
        return None
    return f"{ik}-{iterations}" if ik == "lbfgs" and iterations else str(ik)


def deployment_id(config: Mapping[str, Any]) -> str:
    """Return the identity of a run's deployment: a word and 16 hex digits."""
    return deployment_id_of(deployment_settings(config))


def deployment_id_of(settings: Mapping[str, Any]) -> str:
    """Return the identity of a deployment with these settings, with the present component versions."""
    name = settings.get("precision", "fp32")
    return f"{name}-{_digest({'settings': settings, 'component_versions': deployment_versions(settings)})}"


def deployment_versions(settings: Mapping[str, Any]) -> dict[str, int]:
    """Return the component versions of the components that a deployment with these settings uses."""
    graph, name = settings.get("graph", "auto"), settings.get("precision", "fp32")
    graphs = [f"graph.{one}" for one in ("streaming", "naive") if graph in (one, "auto")]
    return find_versions(["export", "latency", *graphs, *([name] if name != "fp32" else [])])


def deployment_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that determine a deployment's result, besides the run and its data."""
    own = {key: _canonical(value) for key, value in config.get("export", {}).items()}
    return own | inference(config)


def list_components(kind: str, config: Mapping[str, Any]) -> Iterable[str]:
    """Yield the names of the components on which a training's numbers depend."""
    yield from ("features", "sampler", "training")
    if (config.get("data") or {}).get("mirror"):
        yield "mirror"
    if coordinates := config.get("normalizer", {}).get("coordinates"):
        yield f"coordinates.{coordinates}"
    yield from (f"{slot}.{name}" for slot in SLOTS if (name := option_in_slot(config, slot)))
    if (config.get("loss") or {}).get("weighting") == "learned":
        yield "weighting.learned"
    optim = config.get("optim", {})
    if schedule := optim.get("schedule"):
        yield f"schedule.{schedule}"
    yield from (name for name in ("warmup", "ema") if optim.get(name))
    if optim.get("precision") == "bf16":
        yield "precision.bf16"
    if kind == "vqvae" or option_in_slot(config, "memory") == "vq_joint":
        yield from ("vqvae", f"codebook.{config.get('vqvae', {}).get('codebook')}")
    if kind == "vqvae":
        yield "schedule.milestones"


def training_settings(kind: str, config: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the config group that has the number of training steps for a kind of run."""
    if kind == "vqvae":
        return config["vqvae"]
    return config["optim"] if kind == NETWORK else config["prerequisite"][kind]


def option_in_slot(config: Mapping[str, Any], slot: str) -> str | None:
    """Return the name of the option in a slot; None if the slot is empty."""
    return (config.get(slot) or {}).get("name")


def training_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config values that can change a training's result, by dotted key; null counts as no key."""
    rollout = option_in_slot(config, "rollout") or "teacher_forcing"
    as_live = config.get("refiner") or config.get("prerequisite") or rollout != "teacher_forcing"
    out = (*NEUTRAL, *EVALUATION, *DEPLOYMENT, *(() if as_live else INFERENCE))
    flat = {key: value for key, value in flatten(config).items() if value is not None}
    counting = [key for key in flat if DRAWS.fullmatch(key) or not _below(key, out)]
    return {key: _canonical(flat[key]) for key in counting}


def changes_training(key: str, config: Mapping[str, Any]) -> bool:
    """Return whether a dotted key can change the training of this config, or its data."""
    return key.startswith("data.") or any(_below(name, [key]) for name in training_config(config))


def validated_on(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config values that decide on which clips a training is validated, by dotted key."""
    flat = flatten({"data": config.get("data") or {}})
    drawn = {key for key in flat if DRAWS.fullmatch(key) or key == "data.split.train_fraction"}
    return {key: _canonical(value) for key, value in flat.items() if key not in drawn}


def is_data_path(key: str) -> bool:
    """Return whether a dotted key is a path to data; data is identified by its digest, not by its path."""
    return DATA_PATH.fullmatch(key) is not None


def belongs(run_id: str | None, folder: Path) -> bool:
    """Return whether a file of the run with that id is in that run's folder.

    A folder with another name than an id is a copy of a run: everything in it belongs to the run.
    """
    return run_id in (None, folder.name) or not ID.fullmatch(folder.name)


def used_as_configured(settings: Mapping[str, Any], config: Mapping[str, Any]) -> bool:
    """Return whether a stage's settings use the network in the way that the run's own config does."""
    return all(settings.get(key) == value for key, value in inference(config).items())


def describe_other_export(settings: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Say in which settings a deployment's file is not the one of the run's config, such as "naive-int8".

    It is empty where it is that file. A config without one (`export.graph=off`) stands for the default graph.
    """
    export = config.get("export") or {}
    own = {**export, "graph": "auto"} if export.get("graph") in ("off", False) else export
    made = {key: settings.get(key, default) for key, default in EXPORTED.items()}
    other = {key: value for key, value in made.items() if value != own.get(key, EXPORTED[key])}
    return "-".join(f"opset{value}" if key == "opset" else str(value) for key, value in other.items())


def inference(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config's keys that matter when the network is used."""
    flat = flatten(config)
    return {key: _canonical(flat[key]) for key in INFERENCE if key in flat}


def _below(key: str, names: Iterable[str]) -> bool:
    return any(key == name or key.startswith(f"{name}.") for name in names)


def _digest(what: Mapping[str, Any]) -> str:
    text = json.dumps(plain(what), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _canonical(value: Any) -> Any:
    """Return a value in one form for equal numbers, however they were typed (1 or 1.0)."""
    if isinstance(value, list | tuple):
        return [_canonical(item) for item in value]
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a nested mapping as a flat one with dotted keys; lists stay as they are."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
