"""Identities: digests of everything that can change a result, one for each stage that makes results.

A **run** is a training (of a VQ-VAE or of a network): its identity is its config, its data, the run that it
builds upon, and the recipe versions of the components it uses. An **evaluation** of it (one mode, with or
without inverse kinematics) and a **deployment** (ONNX, int8, latency) have identities of their own, made only
from what can change their own result. So a new mode, inverse kinematics or precision on a finished run
repeats only that stage, not the training. A component is identified by its name in the config, never by the
path of its class.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from memmlp.common.components import declared
from memmlp.common.files import plain
from memmlp.runs.former_keys import former_option, with_former_names
from memmlp.runs.recipe_versions import recipes

NEUTRAL = (
    "data",  # its digest stands for it: frames, clips, split and rest pose; but see `_draws`
    "profile",  # sizes, read by the groups that use them
    "paths",
    "loggers",
    "device",  # recorded, and flagged where runs that are compared differ in it
    "threads",
    "force",
    "plugins",  # says which packages are looked at; what is used of them has its path in the config
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
"""The kind of the runs of motion networks, of baselines too; all other kinds are upstream of these."""

ID = re.compile(r"[0-9a-f]{16}")
"""What the id of a run looks like."""

DATA_PATH = re.compile(r"data\.(root|body|split\.folder|sources\..+\.root)")
"""The keys that say where data lies."""

DRAWS = re.compile(r"data\.(drawn_by|mirror|split\.train_fraction|sources\..+\.weight)")
"""The keys of the data that change what is trained on alone, not what is validated and tested."""

SLOTS = ("model", "memory", "predictor", "rollout", "loss", "hand", "term", "refiner", "upstream", "optim")

VQVAE_SHAPE = ("codes", "width", "encoder_depth", "decoder_depth", "commitment", "decay", "codebook")
"""The keys of a VQ-VAE that count if it is trained with the network; the others are of its own training."""

UNNAMED = {"optim": "adamw"}
"""The options of slots that runs have from before these were slots; their names do not count."""

UNNAMED_EXPORT = (("opset", 18), ("alone", False))
"""Settings of deployments from before they were keys; they do not count."""

EXPORTED = {"graph": "auto", "precision": "fp32", "opset": 18}
"""The keys of `export` that decide which file is made, with what they are where they are missing."""


@dataclass(frozen=True)
class Identity:
    """The identity of a run.

    Attributes:
        kind: NETWORK for every motion network, including baselines; for a run upstream of one, "vqvae" or the
            name of the part that is trained. Ids are digests of this word.
        config: the resolved config; only the keys that can change a training's result are used.
        data: digest of the prepared data.
        upstream: the identity of the run whose weights this one uses.
    """

    kind: str
    config: Mapping[str, Any]
    data: str
    upstream: Identity | None = None

    @property
    def recipes(self) -> dict[str, int]:
        """The recipe versions of the components that the training uses."""
        return recipes(list(trained_components(self.kind, self.config)))

    @property
    def id(self) -> str:
        """A digest of everything that can change the result, 16 hex digits."""
        above = self.upstream.id if self.upstream else None
        return run_id(self.kind, self.config, data=self.data, upstream=above)

    @property
    def what(self) -> str:
        """A digest of everything that is in `id` except the recipe versions.

        It is equal for runs that differ only in the age of their code.
        """
        above = self.upstream.what if self.upstream else None
        return _digest(_training(self.kind, self.config, self.data, above))


def run_id(kind: str, config: Mapping[str, Any], *, data: str, upstream: str | None) -> str:
    """Return the identity of a training: a digest of everything that can change its result, 16 hex digits.

    Args:
        kind: see Identity.
        config: the resolved config; keys that are neutral or belong to a later stage are ignored, and 1
            equals 1.0.
        data: digest of the prepared data.
        upstream: id of the run whose weights this one uses.
    """
    what = _training(kind, config, data, upstream)
    return _digest(what | {"recipes": recipes(list(trained_components(kind, config)))})


def evaluation_id(config: Mapping[str, Any], mode: str, groups_digest: str | None = None) -> str:
    """Return the identity of a run's evaluation in a mode: a word and 16 hex digits."""
    return evaluation_id_of(evaluation_settings(config, mode, groups_digest))


def evaluation_id_of(settings: Mapping[str, Any]) -> str:
    """Return the identity of an evaluation with these settings, with the present recipe versions."""
    mode, ik = settings["mode"], settings["ik"]
    name = mode if ik == "off" else f"{mode}-{ik}"
    return f"{name}-{_digest({'settings': settings, 'recipes': evaluation_recipes(settings)})}"


def evaluation_recipes(settings: Mapping[str, Any]) -> dict[str, int]:
    """Return the recipe versions of the components that an evaluation uses."""
    solver = [f"ik.{settings['ik']}"] if settings["ik"] != "off" else []
    own = [f"metric.{name}" for name in settings.get("metrics", ())]
    return recipes(["metrics", f"mode.{settings['mode']}", *solver, *own])


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
    """Return the identity of a deployment with these settings, with the present recipe versions."""
    name = settings.get("precision", "fp32")
    return f"{name}-{_digest({'settings': settings, 'recipes': deployment_recipes(settings)})}"


def deployment_recipes(settings: Mapping[str, Any]) -> dict[str, int]:
    """Return the recipe versions of the components that a deployment with these settings uses."""
    graph, name = settings.get("graph", "auto"), settings.get("precision", "fp32")
    graphs = [f"graph.{one}" for one in ("streaming", "naive") if graph in (one, "auto")]
    return recipes(["export", "latency", *graphs, *([name] if name != "fp32" else [])])


def deployment_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that determine a deployment's result, besides the run and its data."""
    own = {key: _canonical(value) for key, value in config.get("export", {}).items()}
    counting = {key: value for key, value in own.items() if (key, value) not in UNNAMED_EXPORT}
    return counting | inference(config)


def trained_components(kind: str, config: Mapping[str, Any]) -> Iterable[str]:
    """Yield the names of the components on which a training's numbers depend."""
    yield from ("features", "sampler", "training")
    if (config.get("data") or {}).get("mirror"):
        yield "mirror"
    if coordinates := config.get("normalizer", {}).get("coordinates"):
        yield f"coordinates.{coordinates}"
    names = {slot: former_option(slot, option_in_slot(config, slot)) for slot in SLOTS}
    yield from (f"{slot}.{name}" for slot, name in names.items() if name and name != UNNAMED.get(slot))
    if (config.get("loss") or {}).get("weighting") == "learned":
        yield "weighting.learned"
    optim = config.get("optim", {})
    if schedule := optim.get("schedule"):
        yield f"schedule.{schedule}"
    yield from (name for name in ("warmup", "ema") if optim.get(name))
    if optim.get("precision") == "bf16":
        yield "precision.bf16"
    if kind == "vqvae" or names["memory"] == "vq_joint":
        yield from ("vqvae", f"codebook.{config.get('vqvae', {}).get('codebook')}")
    if kind == "vqvae":
        yield "schedule.milestones"


def training_settings(kind: str, config: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the config group that has the number of training steps for a kind of run."""
    if kind == "vqvae":
        return config["vqvae"]
    return config["optim"] if kind == NETWORK else config["upstream"][kind]


def option_in_slot(config: Mapping[str, Any], slot: str) -> str | None:
    """Return the name of the option in a slot; None if the slot is empty, and for Mem-MLP in `model`."""
    return (config.get(slot) or {}).get("name", UNNAMED.get(slot))


def training_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config values that can change a training's result, by dotted key; null counts as no key."""
    rollout = (config.get("rollout") or {}).get("name", "teacher_forcing")
    as_live = config.get("refiner") or config.get("upstream") or rollout != "teacher_forcing"
    out = (*NEUTRAL, *EVALUATION, *DEPLOYMENT, *(() if as_live else INFERENCE), *_unused(config))
    flat = {key: _canonical(value) for key, value in flatten(config).items() if value is not None}
    counting = {key: flat[key] for key in flat if not _below(key, out)}
    inert = {key: value for key, value in _inert(config).items() if key in counting}
    return counting | inert | _draws(config)


def _draws(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings with which windows are drawn, which the data's digest does not cover."""
    data = config.get("data")
    if not data:
        return {}
    sources = (data.get("sources") or {}).items()
    weights = {name: _canonical(source.get("weight")) for name, source in sources}
    shares = {"data.sources": weights} if any(weights.values()) else {}
    mirror = {"data.mirror": True} if data.get("mirror") else {}
    return {"data.drawn_by": data.get("drawn_by", "frames"), **shares, **mirror}


def _training(kind: str, config: Mapping[str, Any], data: str, upstream: str | None) -> dict[str, Any]:
    """Return what a training's identity is the digest of, but for recipes; keys have their former names."""
    named = with_former_names(training_config(config))
    return {"kind": kind, "config": named, "data": data, "upstream": upstream}


def changes_training(key: str, config: Mapping[str, Any]) -> bool:
    """Return whether a dotted key can change the training of this config, or its data."""
    counting = training_config(config).keys() - _inert(config).keys()
    return key.startswith("data.") or any(_below(name, [key]) for name in counting)


def validated_on(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config values that decide on which clips a training is validated, by dotted key."""
    flat = flatten({"data": config.get("data") or {}})
    return {key: _canonical(value) for key, value in flat.items() if not DRAWS.fullmatch(key)}


def is_data_path(key: str) -> bool:
    """Return whether a dotted key is a path to data; data is identified by its digest, not by its path."""
    return DATA_PATH.fullmatch(key) is not None


def belongs(run_id: str | None, folder: Path) -> bool:
    """Return whether a file of the run with that id is in that run's folder.

    A folder whose name is no id is a copy of a run, to which everything in it belongs.
    """
    return run_id in (None, folder.name) or not ID.fullmatch(folder.name)


def used_as_configured(settings: Mapping[str, Any], config: Mapping[str, Any]) -> bool:
    """Return whether a stage's settings use the network in the way that the run's own config does."""
    return all(settings.get(key) == value for key, value in inference(config).items())


def exported_otherwise(settings: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Say in which settings a deployment's file is not the one of the run's config, such as "naive-int8".

    It is empty where it is that file. A config without one (`export.graph=off`) stands for the default graph.
    """
    export = config.get("export") or {}
    own = {**export, "graph": "auto"} if export.get("graph") in ("off", False) else export
    made = {key: settings.get(key, default) for key, default in EXPORTED.items()}
    other = {key: value for key, value in made.items() if value != own.get(key, EXPORTED[key])}
    return "-".join(f"opset{value}" if key == "opset" else str(value) for key, value in other.items())


def inference(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys that matter when the network is used, as far as the config has them."""
    flat = flatten(config)
    return {key: _canonical(flat[key]) for key in INFERENCE if key in flat}


def _unused(config: Mapping[str, Any]) -> Iterable[str]:
    """Yield the keys that have no effect, given the values of the others."""
    optim = config.get("optim", {})
    if optim.get("schedule", "step") != "step":
        yield "optim.drop_at"
    if option_in_slot(config, "optim") == UNNAMED["optim"]:
        yield "optim.name"
    if optim.get("vectors") == "muon" or option_in_slot(config, "model") == "recurrent_poser":
        yield "optim.vectors"  # as in runs before this key, and of a network without vectors
    if not optim.get("warmup"):
        yield "optim.warmup"
    if config.get("vqvae", {}).get("codebook", "ema") != "ema":
        yield "vqvae.decay"
    if (config.get("refiner") or {}).get("velocities") == "joints":
        yield "refiner.velocities"  # those of runs before this key
    if (config.get("model") or {}).get("own_dropout"):
        yield "model.own_dropout"  # as in runs before this key
    loss = config.get("loss") or {}
    if loss.get("name") == "uncertainty":
        yield "term.weight"  # it is learned
    if loss.get("name") == "terms" and loss.get("weighting") != "learned":
        yield from ("loss.weighting", "loss.lr")  # fixed weights are what runs before these keys have


def _inert(config: Mapping[str, Any]) -> dict[str, float]:
    """Return the keys of fixed loss weights that have no effect with this config, each with its default.

    A run's identity takes the default in place of what the config says: runs from before this rule have it.
    """
    if option_in_slot(config, "loss") != "manual":
        return {}
    inert = {"loss.hand": 0.1} if option_in_slot(config, "hand") == "off" else {}
    if option_in_slot(config, "predictor") in ("rotation_only", "rotation_only_memory"):
        inert |= {"loss.position_branch": 0.5, "loss.velocity_lower_body": 0.1}
    return inert


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
