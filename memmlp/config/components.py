"""A component of the config as an object."""

from __future__ import annotations

from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig


def built(node: DictConfig, **given: Any) -> Any:
    """The object of a slot's option, or its partial constructor, from all of its keys but `name`."""
    own = {key: value for key, value in node.items() if key != "name"}
    return instantiate(own, _convert_="all", **given)
