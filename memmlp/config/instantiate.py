"""Builds a component from its config."""

from __future__ import annotations

from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf

from memmlp.common.errors import InputError


def built(node: DictConfig, **given: Any) -> Any:
    """Build the object that a slot's option stands for, or a constructor with its keys filled in.

    All keys of the option except `name` become arguments, and so do those in `given`. An option with
    `_partial_` gives a partial constructor, which is called once the remaining arguments are known.

    Raises:
        InputError: if the class does not exist, or its constructor refuses the arguments; the message names
            the class.
    """
    resolved: dict[str, Any] = OmegaConf.to_container(node, resolve=True)  # type: ignore[assignment]
    own = {key: value for key, value in resolved.items() if key != "name"}
    try:
        return instantiate(own, _convert_="all", **given)
    except InstantiationException as error:
        if isinstance(error.__cause__, InputError):
            raise error.__cause__ from None
        raise InputError(f"{own['_target_']}: cannot be built: {_reason(error)}") from error


def _reason(error: InstantiationException) -> str:
    """Return in one line what went wrong in building a component."""
    return str(error.__cause__ or error).splitlines()[0]


def located(path: str, key: str) -> Any:
    """Return the class or function at a dotted path. Raises InputError, naming the key, if there is none."""
    try:
        return get_object(path)
    except (ImportError, ValueError, InstantiationException) as error:
        raise InputError(f"{key}: {path}: {str(error).splitlines()[0]}") from error
