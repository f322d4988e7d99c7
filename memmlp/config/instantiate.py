"""Build a component from its config."""

from __future__ import annotations

from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig


def built(node: DictConfig, **given: Any) -> Any:
    """Build the object that a slot's option stands for, or a constructor with its keys filled in.

    All keys of the option but `name` become arguments, and so do those in `given`. An option with `_partial_`
    gives a partial constructor, which is called once the rest of the arguments is known.
    """
    own = {key: value for key, value in node.items() if key != "name"}
    return instantiate(own, _convert_="all", **given)
