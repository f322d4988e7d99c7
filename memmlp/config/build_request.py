"""Builds the run request of a composed config. It does not import torch, so planning is fast."""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import getitem
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from memmlp.common.components import Component, component, find_component
from memmlp.common.errors import InputError
from memmlp.common.overrides import flatten
from memmlp.common.settings import Settings, at_least, positive, setting
from memmlp.common.text_formats import escape_interpolations
from memmlp.config import plugins
from memmlp.config.check import CheckedConfig
from memmlp.motion.clip import LINES
from memmlp.motion.motion_source import MotionSource
from memmlp.motion.preparing.cache import ClipFolder
from memmlp.motion.preparing.find_clips import NamedFolders, Root
from memmlp.motion.preparing.persons import Kind, PersonSplit
from memmlp.motion.preparing.splits import ListSplit, MixedSplit, SeededSplit, Split, SubsetSplit
from memmlp.training.request import RunRequest

SPLITS = {"seeded": SeededSplit, "lists": ListSplit, "subsets": SubsetSplit, "persons": PersonSplit}


def build_motion(config: Mapping[str, Any]) -> MotionSource:
    """Build the source of an experiment's motion from a resolved config. The name of a synthetic folder
    contains the generator's settings and its component version above 1. Raises InputError if a list of groups
    cannot be read, two folders have the same name, or the generator does not exist."""
    data = config["data"]
    root, split = _build_clip_request(data)
    generate: Callable[[Path], object] | None = None
    if data["synth"] is not None:
        settings = {key: value for key, value in data["synth"].items() if key != "name"}
        generator = find_component("generator", data["synth"]["name"])
        folder = "-".join([generator.name, *(f"{key}{value}" for key, value in settings.items())])
        folder = folder.replace("/", "_")  # a setting must not choose another folder
        if generator.name == "puppet":
            folder = f"{settings['minutes']:g}min-seed{settings['seed']}"
        version = f"-v{generator.version}" if generator.version > 1 else ""
        root = Path(data["root"]) / f"{folder}{version}"
        generate = partial(_call_generator, generator, settings)

    interpolation = data.get("interpolation", LINES)  # old configs without the key used lines
    clips = ClipFolder(root, split, str(data["body"]), data["min_frames"], data["strict"], interpolation)
    caches = Path(config["paths"]["outputs"]) / "cache"
    return MotionSource(clips, generate, caches, partial=data.get("partial", False))


def _call_generator(generator: Component, settings: Mapping[str, Any], folder: Path) -> None:
    generator.kind(folder, **settings)


@component("generator", "puppet", builds="synthesize")
@dataclass
class PuppetSettings(Settings):
    """Procedural motion of a puppet."""

    minutes: float = setting(positive(), "${profile.synth_minutes}")
    seed: int = setting(at_least(0), 0)


def synthesize(folder: Path, minutes: float, seed: int) -> None:
    """Write synthetic clips with a total length of `minutes` to a folder."""
    from memmlp.motion.synthetic import synthesize  # imports torch

    synthesize(folder, minutes=minutes, seed=seed)


def read_source_weights(data: DictConfig) -> Mapping[str, float] | None:
    """Return each source's relative weight among training windows; None if no source sets a weight."""
    weights = {name: source.get("weight") for name, source in (data.get("sources") or {}).items()}
    return weights if any(weights.values()) else None


def _build_clip_request(data: Mapping[str, Any]) -> tuple[Root, Split]:
    keys = copy.deepcopy(data["split"])
    if "kinds" in keys:
        keys["kinds"] = {name: Kind(**kind) for name, kind in keys["kinds"].items()}
    split: Any = SPLITS[keys.pop("name")](**keys)
    if sources := data.get("sources"):
        folders = NamedFolders({name: Path(source["root"]) for name, source in sources.items()})
        splits = {name: _build_source_split(split, name, source) for name, source in sources.items()}
        return folders, MixedSplit(splits)
    roots = data["root"] if isinstance(data["root"], list) else [data["root"]]
    if len(roots) == 1:
        return Path(roots[0]), split
    folders = NamedFolders.from_paths([Path(root) for root in roots])
    return folders, MixedSplit(dict.fromkeys(folders.sources, split))


def _build_source_split(split: SeededSplit, name: str, source: Mapping[str, Any]) -> SeededSplit:
    fractions: Any = {part: source.get(part) for part in ("test", "val") if source.get(part) is not None}
    groups = [*split.groups, *(source.get("groups") or ())]
    try:
        return replace(split, groups=groups, groups_file=source.get("groups_file"), **fractions)
    except InputError as error:
        raise InputError(f"data.sources.{name}: {error}") from None


def build_request(cfg: DictConfig) -> RunRequest:
    """Build the run request of a checked config. Raises InputError if a package of the config is not in
    use."""
    config = cast(dict[str, Any], OmegaConf.to_container(cfg, resolve=True))
    config["plugins"] = plugins.find_used_packages(config)
    return RunRequest(config, build_motion(config))


def build_requests(checked: CheckedConfig, outputs: Path, seeds: Sequence[int]) -> Iterator[RunRequest]:
    """Yield the run request of a config in an outputs folder for each seed. Resolving is slow, so only these
    keys, and keys that refer to them, are resolved again."""
    cfg, config = checked
    config = {**config, "plugins": plugins.find_used_packages(config)}
    cfg.paths.outputs = escape_interpolations(str(outputs))
    keys = _list_dependents(cfg, "paths.outputs", "seed")
    same_motion = not any(key.startswith("data.") for key in _list_dependents(cfg, "seed"))
    motion = None
    for seed in seeds:
        cfg.seed, config = seed, copy.deepcopy(config)
        for key in keys:
            *groups, last = key.split(".")
            value = OmegaConf.select(cfg, key)
            plain = OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
            reduce(getitem, groups, config)[last] = plain
        motion = motion if motion and same_motion else build_motion(config)
        yield RunRequest(config, motion)


def _list_dependents(cfg: DictConfig, *changed: str) -> list[str]:
    """Return these dotted keys and all keys that may refer to them, directly or not."""
    raw = flatten(cast(dict[str, Any], OmegaConf.to_container(cfg)))
    texts = {key: str(value) for key, value in raw.items() if "${" in str(value)}
    found, before = set(changed), set[str]()
    while found != before:
        before, parts = set(found), {part for key in found for part in key.split(".")}
        found |= {key for key, text in texts.items() if any(part in text for part in parts)}
    return sorted(found)
