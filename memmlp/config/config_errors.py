"""Explains errors of Hydra and OmegaConf in one line that names the key and what was expected."""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Sequence
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from hydra.errors import ConfigCompositionException, MissingConfigException, OverrideParseException
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    ConfigTypeError,
    InterpolationKeyError,
    OmegaConfBaseException,
    ValidationError,
)

from memmlp.config.check import unknown_key

SOURCES = "data.sources"
WORDS = {int: "an integer", float: "a number", bool: "true or false", str: "text", NoneType: "null"}


def explain(error: Exception, overrides: Sequence[str]) -> str:
    """Return the line for an error that was raised while composing these overrides."""
    if isinstance(error, OverrideParseException):
        return f"{error.override}: cannot be parsed; expected KEY=VALUE, +KEY=VALUE or ~KEY"
    if isinstance(error, MissingConfigException):
        return _missing_option(error)
    if isinstance(error, RecursionError):
        reason = "a defaults list includes itself; write '- NAME' for another option of the same group"
        return f"{' '.join(overrides)}: {reason}"
    below = error.__cause__ or error.__context__
    if isinstance(below, OmegaConfBaseException):
        match = re.match(r"Error merging override (.*)", str(error), re.DOTALL)
        return _typed(below, match[1] if match else None)
    if isinstance(error, OmegaConfBaseException):
        return _typed(error, None)
    if isinstance(error, ConfigCompositionException):
        return _composition(str(error))
    reason = "a key below one that is null" if isinstance(error, AssertionError) else _first_line(error)
    return f"{' '.join(overrides)}: cannot be composed: {reason}"


def _missing_option(error: MissingConfigException) -> str:
    group, _, option = (error.missing_cfg_file or "").rpartition("/")
    if not error.options:
        return _first_line(error)
    near = difflib.get_close_matches(option, error.options, n=1)
    hint = f"did you mean {near[0]}? " if near else ""
    return f"{group}={option}: no such option; {hint}must be one of {', '.join(error.options)}"


def _typed(error: OmegaConfBaseException, override: str | None) -> str:
    """Explain what the schema rejected: an unknown key, a value of a wrong type, or a key's removal."""
    name = str(error.full_key or override)
    schema = error.object_type
    if not dataclasses.is_dataclass(schema) and ("SourceConfig" in str(error) or name.startswith(SOURCES)):
        return f"{SOURCES}: must be set in your own config file (docs/guides/motion.md)"
    if isinstance(error, ConfigAttributeError | ConfigKeyError) and not isinstance(
        error, InterpolationKeyError
    ):
        keys = (
            [field.name for field in dataclasses.fields(schema)] if dataclasses.is_dataclass(schema) else []
        )
        return unknown_key(name, keys)
    if isinstance(error, ValidationError):
        shown = override if override and override.lstrip("+").startswith(f"{name}=") else name
        return f"{shown}: expected {_expected(name, schema, error)}"
    if isinstance(error, ConfigTypeError):
        return f"{name}: cannot be removed; set a value, {name}=..."
    return f"{override or name}: {_first_line(error)}"


def _expected(name: str, schema: Any, error: OmegaConfBaseException) -> str:
    """Return in words the type and limits that the schema has for a key."""
    if not dataclasses.is_dataclass(schema):
        return f"{_words(error.ref_type)} ({_first_line(error)})"
    own = name.split(".")[-1]
    hint = get_type_hints(schema).get(own, Any)
    rule = next(
        (field.metadata.get("rule") for field in dataclasses.fields(schema) if field.name == own), None
    )
    return _words(hint) if rule is None else f"{_words(hint)}, {rule}"


def _words(hint: Any) -> str:
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(_words(part) for part in parts))
    if origin is list:
        return f"a list, each item {_words(parts[0])}"
    if dataclasses.is_dataclass(hint):
        return "a group of " + ", ".join(field.name for field in dataclasses.fields(hint))
    return WORDS.get(hint, str(getattr(hint, "__name__", hint)))


def _composition(text: str) -> str:
    """Return Hydra's own message without its advice on other ways to write the command."""
    ambiguous = re.match(r"Ambiguous value for argument '(.*)'", text)
    if ambiguous:
        return f"{ambiguous[1]}: expected one value, a list [a,b], or several values with -m"
    return "; ".join(line.strip() for line in text.splitlines() if line.strip())


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), "") or type(error).__name__
