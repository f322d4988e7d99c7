"""Builds the request of a composed config, without torch, so that planning and finished runs are quick."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from memmlp.config import plugins
from memmlp.config.build_motion import build_motion
from memmlp.runs.identity import flatten
from memmlp.training.request import RunRequest


def build_request(cfg: DictConfig) -> RunRequest:
    """Return what a checked config asks for.

    Raises:
        InputError: if a package of the config is not in use, or its motion source cannot be built.
    """
    config = cast(dict[str, Any], OmegaConf.to_container(cfg, resolve=True))
    config["plugins"] = plugins.used(config)
    return RunRequest(config, build_motion(cfg))


def build_requests(cfg: DictConfig, seeds: Sequence[int]) -> Iterator[RunRequest]:
    """Yield what a checked config asks for with each of several seeds.

    Resolving a config takes most of the time, so that is done once: for further seeds, only the seed and the
    keys that refer to it are resolved.
    """
    cfg.seed = seeds[0]
    first = build_request(cfg)
    yield first
    raw = flatten(cast(dict[str, Any], OmegaConf.to_container(cfg)))
    keys = ["seed", *(key for key, value in raw.items() if "${" in str(value) and "seed" in str(value))]
    for seed in seeds[1:]:
        cfg.seed = seed
        config = copy.deepcopy(first.config)
        for key in keys:
            *groups, last = key.split(".")
            tree = config
            for group in groups:
                tree = tree[group]
            tree[last] = OmegaConf.select(cfg, key)
        same_motion = not any(key.startswith("data.") for key in keys)
        yield replace(first, config=config) if same_motion else build_request(cfg)
