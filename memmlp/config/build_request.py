"""Builds the request of a composed config, without torch, so that planning and finished runs are quick."""

from __future__ import annotations

from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from memmlp.config import plugins
from memmlp.config.build_motion import build_motion
from memmlp.training.request import RunRequest


def build_request(cfg: DictConfig) -> RunRequest:
    """Return what a checked config asks for.

    Raises:
        InputError: if a package of the config is not in use, or its motion source cannot be built.
    """
    config = cast(dict[str, Any], OmegaConf.to_container(cfg, resolve=True))
    config["plugins"] = plugins.used(config)
    return RunRequest(config, build_motion(cfg))
