"""Checks of a composed config before anything runs; each error is one line that names the key."""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Iterator, Sequence
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from hydra.errors import ConfigCompositionException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    ConfigTypeError,
    InterpolationKeyError,
    OmegaConfBaseException,
    ValidationError,
)

from memmlp.common.components import SLOTS, find_chosen_settings
from memmlp.common.errors import InputError
from memmlp.config.schema import Config


def check(cfg: DictConfig) -> None:
    """Check a composed config.

    Raises:
        InputError: for a missing or unknown key, a value that its rule does not allow, or values that cannot
            be combined; the message names the key.
    """
    if OmegaConf.get_type(cfg) is not Config:
        raise InputError("config: must start from /schema/config, as conf/train.yaml does")
    for name, value, rule in _values(cfg, ""):
        if rule is not None and value is not None and not rule.allows(value):
            shown = list(value) if OmegaConf.is_list(value) else value
            raise InputError(f"{name}={shown}: must be {rule.words}")
    for slot in SLOTS:
        for problem in settings.problems(cfg) if (settings := find_chosen_settings(cfg, slot)) else ():
            raise InputError(problem)
    for problem in _problems(cfg):
        raise InputError(problem)


def _values(node: DictConfig, prefix: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield the dotted name, value and rule of every key below a typed node.

    Raises:
        InputError: for a key that is not in the schema.
    """
    schema: Any = OmegaConf.get_type(node)
    if not dataclasses.is_dataclass(schema):  # a dictionary of groups, or of values
        for name in map(str, node):
            if isinstance(node[name], DictConfig):
                yield from _values(node[name], f"{prefix}{name}.")
        return
    known = [spec.name for spec in dataclasses.fields(schema)]
    for extra in sorted(set(map(str, node)) - set(known)):
        raise InputError(unknown_key(prefix + extra, known))
    for spec in dataclasses.fields(schema):
        name = prefix + spec.name
        value = _value(node, spec.name, name)
        if isinstance(value, DictConfig):
            yield from _values(value, f"{name}.")
        else:
            yield name, value, spec.metadata.get("rule")


def unknown_key(name: str, keys: Sequence[str]) -> str:
    """Return the error line for a dotted key that is not among the keys of its group."""
    own = re.split(r"[./@]", name)[-1]
    near = difflib.get_close_matches(own, keys, n=1)
    hint = f"did you mean {near[0]}? " if near else ""
    listed = ", ".join(keys) or "none"
    return f"{name}: no such key; {hint}allowed here: {listed}"


def _value(node: DictConfig, own: str, name: str) -> Any:
    """Return a key's value. Raises InputError if it is missing or cannot be resolved."""
    if OmegaConf.is_missing(node, own):
        raise InputError(f"{name}: has no value; give one with {name}=...")
    try:
        return node[own]
    except OmegaConfBaseException as error:
        raise InputError(f"{name}: {str(error).splitlines()[0]}") from None


def _problems(cfg: DictConfig) -> Iterator[str]:
    """Yield values that cannot be combined, except those that a component checks."""
    for name, node in cfg.loggers.items():
        if node.name != name:
            yield f"loggers.{name}.name={node.name}: must be {name}, the logger's key"
    if "streams" in cfg.rollout and cfg.rollout.streams < cfg.optim.batch:
        yield f"rollout.streams={cfg.rollout.streams}: must be at least optim.batch={cfg.optim.batch}"
    if (cfg.vqvae.epochs is None) == (cfg.vqvae.steps is None):
        given = f"vqvae.epochs={cfg.vqvae.epochs}, vqvae.steps={cfg.vqvae.steps}"
        yield f"{given}: one of them must be null, and the other a number"
    yield from _data_problems(cfg.data)
    precision = f"export.precision={cfg.export.precision}: must be fp32"
    if cfg.export.precision != "fp32" and cfg.export.graph in ("naive", "off"):
        yield f"{precision} with export.graph={cfg.export.graph}, since others need the streaming graph"
    if cfg.export.precision != "fp32" and cfg.memory is not None and cfg.memory.get("history") == "latest":
        yield f"{precision} with memory.history=latest, which has no streaming graph"


def _data_problems(data: DictConfig) -> Iterator[str]:
    sources = data.get("sources") or {}
    if (data.root is None) == (not sources):
        yield f"data.root={data.root}: must be a folder or a list of folders, or null with data.sources"
    if bad := [name for name in map(str, sources) if not re.fullmatch(r"[\w-]+", name)]:
        yield f"data.sources.{bad[0]}: a name must have only letters, digits, - and _"
    weights = [source.weight for source in sources.values()]
    if any(weights) and not all(weights):
        yield "data.sources: must have a weight for each source, or for none"
    if (sources or OmegaConf.is_list(data.root)) and data.split.get("groups_file") is not None:
        yield "data.split.groups_file: must be null with several folders; set data.sources.NAME.groups_file"
    split = data.split
    held_out = split.get("val", 0) + (split.test if isinstance(split.get("test"), float) else 0)
    if held_out >= 1:
        yield f"data.split.val={split.val}: must be less than what data.split.test leaves of 1"


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
