"""A run's readable name, which shows changes from the default config, such as "memory=gru · seed 1"."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from memmlp.common.components import SLOTS, collect_components
from memmlp.common.overrides import format_value
from memmlp.config.component_source import register_components
from memmlp.config.compose import VERSION_BASE
from memmlp.config.plugins import find_packaged_folder
from memmlp.runs.identity import NETWORK, find_option, flatten, select_training_config
from memmlp.runs.lookup import describe_kind

MAX_WORDS = 6
SEPARATOR = " · "
SET_BY_MODELS = ("ema",)
"""Keys of a profile that models set. They are omitted, because the groups that use them show the value."""


def make_readable_name(kind: str, config: Mapping[str, Any]) -> str:
    """Return a readable name for a run.

    It lists options of slots, and values of other keys, that differ from the defaults. Data, paths, loggers
    and keys without an effect on the results are omitted.

    Args:
        kind: the kind of run (see `Identity`).
        config: the run's resolved config.
    """
    words = [] if kind == NETWORK else [describe_kind(kind)]
    try:
        words += _list_differences(config)
    except (HydraException, OmegaConfBaseException):  # the run must not fail because of its name
        words.append("own config")
    if len(words) > MAX_WORDS:
        words = [*words[:MAX_WORDS], f"{len(words) - MAX_WORDS} more"]
    seed = config.get("seed", (config.get("vqvae") or {}).get("seed"))
    return SEPARATOR.join([*(words or ["default"]), f"seed {seed}"])


def _list_differences(config: Mapping[str, Any]) -> Iterator[str]:
    """Yield the profile, slots and keys that differ from `memmlp train` without overrides."""
    chosen: list[str] = []
    if profile := config.get("profile"):
        sizes = f"profile={profile['sizes']}"
        usual = _compose_default((sizes,))["profile"]
        changed = [key for key in profile if key not in SET_BY_MODELS and profile[key] != usual.get(key)]
        chosen = [sizes, *(f"profile.{key}={format_value(profile[key])}" for key in changed)]
        yield from chosen[profile["sizes"] == "small" :]
    named = [slot for slot in SLOTS if slot in config and (config[slot] is None or "name" in config[slot])]
    options = {slot: find_option(config, slot) for slot in named}
    custom = [slot for slot, option in options.items() if option and not _is_shipped(slot, option)]
    for slots in (
        ["model"],
        [slot for slot in options if slot != "model"],
    ):  # a model may set options of other slots
        default = _compose_default(tuple(chosen))
        changed = [slot for slot in slots if slot in options and options[slot] != find_option(default, slot)]
        yield from (f"{slot}={options[slot] or 'none'}" for slot in changed)
        chosen += [f"{slot}={options[slot] or 'null'}" for slot in changed if slot not in custom]
    default = _compose_default(tuple(chosen))
    own, usual = flatten(config), {"data.drawn_by": "frames", "data.mirror": False} | flatten(default)
    for key in select_training_config(config) | select_training_config(
        default
    ):  # a key may count in only one of the configs
        group, _, last = key.partition(".")
        if group in (*custom, "profile") or last == "name" or key in ("seed", "vqvae.seed"):
            continue
        if key in own and own[key] != usual.get(key):
            yield f"{key}={format_value(own[key])}"


def _is_shipped(slot: str, option: str) -> bool:
    found = collect_components().get((slot, option))
    return found is not None and found.package == "memmlp"


@functools.lru_cache(maxsize=64)
def _compose_default(overrides: tuple[str, ...]) -> dict[str, Any]:
    """Return the config of `memmlp train` with these overrides, without groups that names omit.

    Hydra's global state is restored afterwards.
    """
    register_components()
    hydra = GlobalHydra.instance()
    before, hydra.hydra = hydra.hydra, None
    try:
        with initialize_config_dir(
            str(find_packaged_folder("conf")), version_base=VERSION_BASE, job_name="name"
        ):
            cfg = compose("train", list(overrides))
    finally:
        GlobalHydra.instance().hydra = before
    groups = {str(key): cfg[key] for key in cfg if key not in ("data", "paths", "loggers")}
    return {
        key: OmegaConf.to_container(group, resolve=True) if OmegaConf.is_config(group) else group
        for key, group in groups.items()
    }
