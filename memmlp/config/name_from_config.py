"""A run's readable name, which says how its config differs from the default, as in "memory=gru · seed 1"."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from memmlp.common.components import declared
from memmlp.config.component_source import register
from memmlp.config.compose import VERSION_BASE
from memmlp.config.package_data import packaged
from memmlp.config.schema import ProfileConfig
from memmlp.runs.identity import NETWORK, SLOTS, flatten, option_in_slot, training_config
from memmlp.runs.lookup import kind_words

MOST = 6  # words
BETWEEN = " · "
OF_MODELS = ("ema",)
"""Keys of a profile that a model sets; other values show up in the groups that read them."""


def readable_name(kind: str, config: Mapping[str, Any]) -> str:
    """Return a name for a run.

    The name has the option of a slot, and the value of any other key that differs from the option's default.
    It does not include the data, or where and how the run is made.

    Args:
        kind: the kind of run (see `Identity`).
        config: the run's resolved config.
    """
    words = [] if kind == NETWORK else [kind_words(kind)]
    try:
        words += [*_profile(_sizes(config)), *_differences(config)]
    except (HydraException, OmegaConfBaseException):  # a name is no reason to stop a run
        words.append("own config")
    if len(words) > MOST:
        words = [*words[:MOST], f"{len(words) - MOST} more"]
    seed = config.get("seed", (config.get("vqvae") or {}).get("seed"))
    return BETWEEN.join([*(words or ["default"]), f"seed {seed}"])


def _differences(config: Mapping[str, Any]) -> Iterator[str]:
    """Yield words for slots and keys that differ from those of `memmlp train` without overrides."""
    profile = tuple(f"profile.{k}={_word(v)}" for k, v in _sizes(config).items())
    model = _option(config, "model")
    chosen = (f"model={model}",) if _shipped("model", model) else ()
    default = _default((*profile, *chosen))
    if model != "mem_mlp" and "model" in config:
        yield f"model={model}"
    others = {slot for slot in SLOTS if slot != "model" and slot in config}
    changed = {slot: _option(config, slot) for slot in SLOTS if slot in others}
    changed = {slot: option for slot, option in changed.items() if option != _option(default, slot)}
    yield from (f"{slot}={option or 'none'}" for slot, option in changed.items())
    known = tuple(f"{slot}={option}" for slot, option in changed.items() if _shipped(slot, option))
    if known:
        default = _default((*profile, *chosen, *known))
    custom = [slot for slot, option in changed.items() if not _shipped(slot, option)]  # without a default
    custom += [] if chosen else ["model"]
    own, usual = flatten(config), {"data.drawn_by": "frames"} | flatten(default)
    for key in training_config(config) | training_config(default):  # either may count it where it is set
        slot, _, last = key.partition(".")
        if slot in custom or last == "name" or key in ("seed", "vqvae.seed"):
            continue
        if key in own and own[key] != usual.get(key):
            yield f"{key}={_word(own[key])}"


def _option(config: Mapping[str, Any], slot: str) -> str | None:
    """Return the name of the option in a slot; Mem-MLP itself has no name in the config."""
    return option_in_slot(config, slot) or ("mem_mlp" if slot == "model" else None)


def _shipped(slot: str, option: str | None) -> bool:
    found = declared().get((slot, str(option)))
    return found is not None and found.package == "memmlp"


def _word(value: Any) -> str:
    if isinstance(value, list):
        return f"[{','.join(map(_word, value))}]"
    return json.dumps(value) if value is None or isinstance(value, bool) else str(value)  # 1 is not true


@functools.lru_cache(maxsize=64)
def _default(overrides: tuple[str, ...]) -> dict[str, Any]:
    """Return the config of `memmlp train` with these overrides, less the keys that no name tells.

    Hydra's present work is not disturbed.
    """
    register()
    hydra = GlobalHydra.instance()
    before, hydra.hydra = hydra.hydra, None  # that of `memmlp train`, which has but one at a time
    try:
        with initialize_config_dir(str(packaged("conf")), version_base=VERSION_BASE, job_name="name"):
            cfg = compose("train", list(overrides))
    finally:
        GlobalHydra.instance().hydra = before
    groups = {str(key): cfg[key] for key in cfg if key not in ("data", "paths", "loggers")}
    return {
        key: OmegaConf.to_container(group, resolve=True) if OmegaConf.is_config(group) else group
        for key, group in groups.items()
    }


def _sizes(config: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in (config.get("profile") or {}).items() if key not in OF_MODELS}


def _profile(config: Mapping[str, Any]) -> Iterator[str]:
    """Yield the profile's name unless it is `small`, and the keys that differ from that profile."""
    if not config:
        return
    values = {path.stem: _values(path) for path in sorted((packaged("conf") / "profile").glob("*.yaml"))}
    count = {name: sum(own.get(k) != v for k, v in config.items()) for name, own in values.items()}
    nearest = min(count, key=lambda name: (count[name], name != "small"))
    if nearest != "small":
        yield f"profile={nearest}"
    for key, value in config.items():
        if values[nearest].get(key) != value:
            yield f"profile.{key}={_word(value)}"


@functools.cache
def _values(path: Path) -> dict[str, Any]:
    defaults = {spec.name: spec.default for spec in fields(ProfileConfig)}
    return defaults | yaml.safe_load(path.read_text())
