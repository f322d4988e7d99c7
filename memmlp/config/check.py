"""Checks of a composed config before a run starts. Each error is one line that names the key."""

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, NamedTuple, Union, cast, get_args, get_origin, get_type_hints

from hydra.errors import ConfigCompositionException, MissingConfigException, OverrideParseException
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    ConfigTypeError,
    InterpolationKeyError,
    OmegaConfBaseException,
    ValidationError,
)

from memmlp.common.components import SLOTS, find_chosen_settings
from memmlp.common.errors import InputError, suggest
from memmlp.common.overrides import flatten
from memmlp.common.settings import Rule
from memmlp.common.text_formats import join_command, make_override
from memmlp.config.schema import Config


class CheckedConfig(NamedTuple):
    """A composed config, and the same as plain dictionaries with resolved interpolations."""

    cfg: DictConfig
    resolved: dict[str, Any]


def check(cfg: DictConfig) -> CheckedConfig:
    """Check a composed config. Raises InputError for a bad key, a bad value, or values that cannot be
    combined."""
    if OmegaConf.get_type(cfg) is not Config:
        raise InputError("config: must start from /schema/config, as conf/train.yaml does")
    config = _resolve(cfg)
    for name, value, rule in _list_values(cfg, config, ""):
        if value == MISSING:
            raise _make_missing_error(name)
        if rule is not None and value is not None and not rule.allows(value):
            raise InputError(f"{name}={value}: must be {rule.words}")
    for slot in SLOTS:
        for problem in settings.problems(config) if (settings := find_chosen_settings(config, slot)) else ():
            raise InputError(problem)
    for problem in _find_problems(config):
        raise InputError(problem)
    return CheckedConfig(cfg, config)


def _resolve(cfg: DictConfig) -> dict[str, Any]:
    try:
        return cast(dict[str, Any], OmegaConf.to_container(cfg, resolve=True))
    except OmegaConfBaseException:
        for name, value in flatten(cast(dict[str, Any], OmegaConf.to_container(cfg))).items():
            if value == MISSING:
                raise _make_missing_error(name) from None
            try:
                OmegaConf.select(cfg, name)
            except OmegaConfBaseException as error:
                raise InputError(f"{name}: {str(error).splitlines()[0]}") from None
        raise


def _make_missing_error(name: str) -> InputError:
    return InputError(f"{name}: has no value; set {name}=VALUE")


def _list_values(
    node: DictConfig, values: Mapping[str, Any], prefix: str
) -> Iterator[tuple[str, Any, Rule | None]]:
    """Yield dotted name, value and rule of each key in a typed node. Raises InputError for an unknown key."""
    schema: Any = OmegaConf.get_type(node)
    if dataclasses.is_dataclass(schema):
        rules = {spec.name: spec.metadata.get("rule") for spec in dataclasses.fields(schema)}
        for extra in sorted(set(map(str, values)) - set(rules)):
            raise InputError(describe_unknown_key(prefix + extra, list(rules)))
    else:  # a dictionary of groups, or of values
        rules = {name: None for name, value in values.items() if isinstance(value, dict)}
    for name, rule in rules.items():
        if isinstance(values[name], dict):
            yield from _list_values(node[name], values[name], f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", values[name], rule


def describe_unknown_key(name: str, keys: Sequence[str]) -> str:
    """Return the error line for an unknown dotted key of a group with these keys."""
    hint = suggest(re.split(r"[./@]", name)[-1], keys)
    expected = f"expected one of {', '.join(keys)}" if keys else "expected no keys"
    return f"{name}: no such key; {hint}{expected}"


def _find_problems(config: Mapping[str, Any]) -> Iterator[str]:
    for name, logger in config["loggers"].items():
        if logger["name"] != name:
            yield f"loggers.{name}.name={logger['name']}: must be {name}, the name of its key"
    rollout, batch = config["rollout"], config["optim"]["batch"]
    if "streams" in rollout and rollout["streams"] < batch:
        yield f"rollout.streams={rollout['streams']}: must be at least optim.batch={batch}"
    epochs, steps = config["vqvae"]["epochs"], config["vqvae"]["steps"]
    if (epochs is None) == (steps is None):
        values = f"vqvae.epochs={epochs}, vqvae.steps={steps}"
        yield f"{values}: one key must be null, and the other key must be a number"
    yield from _find_data_problems(config["data"])
    export, memory = config["export"], config["memory"] or {}
    precision = f"export.precision={export['precision']}: must be fp32"
    if export["precision"] != "fp32" and export["graph"] in ("naive", "off"):
        yield f"{precision} with export.graph={export['graph']}; lower precisions need the streaming graph"
    if export["precision"] != "fp32" and memory.get("history") == "latest":
        yield f"{precision} with memory.history=latest, which has no streaming graph"


def _find_data_problems(data: Mapping[str, Any]) -> Iterator[str]:
    sources, root, split = data.get("sources") or {}, data["root"], data["split"]
    if (root is None) == (not sources):
        yield f"data.root={root}: must be a folder or a list of folders, or null with data.sources"
    roots = root if isinstance(root, list) else []
    for path in roots:
        if not Path(path).is_dir():
            yield f"data.root=[{', '.join(roots)}]: {path}: no such folder; must be a folder of npz clips"
    if bad := [name for name in map(str, sources) if not re.fullmatch(r"[\w-]+", name)]:
        yield f"data.sources.{bad[0]}: expected a name with only letters, digits, - and _"
    weights = [source["weight"] for source in sources.values()]
    if any(weights) and not all(weights):
        yield "data.sources: expected a weight for every source, or no weights"
    if (sources or isinstance(root, list)) and split.get("groups_file") is not None:
        yield "data.split.groups_file: must be null with several folders; set data.sources.NAME.groups_file"
    files = [one.get("groups_file") for one in (split, *sources.values())]
    if data["drawn_by"] == "groups" and any(files):  # a run's id does not depend on the file's content
        yield "data.drawn_by=groups: cannot be used with a groups_file; set data.split.groups"
    held_out = split.get("val", 0) + (split["test"] if isinstance(split.get("test"), float) else 0)
    if held_out >= 1:
        yield f"data.split.val={split['val']}: must be below 1 in sum with data.split.test"


SOURCES = "data.sources"
WORDS = {int: "an integer", float: "a number", bool: "true or false", str: "text", NoneType: "null"}


def _quote_texts(key: str, value: str) -> str:
    if not (value.startswith("[") and value.endswith("]")):
        return make_override(key, value)
    return f"{key}=[{','.join(make_override('', item.strip())[1:] for item in value[1:-1].split(','))}]"


def explain_error(error: Exception, overrides: Sequence[str]) -> str:
    """Return a line that explains an error while these overrides were composed."""
    if isinstance(error, OverrideParseException):
        key, equals, value = str(error.override).partition("=")
        quoted = f"; quote a text: {join_command([_quote_texts(key, value)])}" if equals else ""
        return f"{error.override}: cannot be parsed; expected KEY=VALUE, +KEY=VALUE or ~KEY{quoted}"
    if isinstance(error, MissingConfigException):
        return _explain_missing_option(error)
    if isinstance(error, RecursionError):
        reason = "a defaults list includes itself; for another option of this group, write '- NAME'"
        return f"{' '.join(overrides)}: {reason}"
    below = error.__cause__ or error.__context__
    if isinstance(below, OmegaConfBaseException):
        match = re.match(r"Error merging override (.*)", str(error), re.DOTALL)
        return _explain_type_error(below, match[1] if match else None)
    if isinstance(error, OmegaConfBaseException):
        return _explain_type_error(error, None)
    if isinstance(error, ConfigCompositionException):
        if ambiguous := re.match(r"Ambiguous value for argument '(.*)'", str(error)):
            return f"{ambiguous[1]}: expected one value, a list [a,b], or several values with -m"
        return "; ".join(line.strip() for line in str(error).splitlines() if line.strip())
    null = next((override for override in overrides if re.fullmatch(r"[\w/]+=null", override)), None)
    if null and "NoneType" in str(error):
        return f"{null}: must be one of its options; ~{null.removesuffix('=null')} removes the group"
    reason = "a parent of the key is null" if isinstance(error, AssertionError) else _get_first_line(error)
    return f"{' '.join(overrides)}: cannot be composed: {reason}"


def _explain_missing_option(error: MissingConfigException) -> str:
    group, _, option = (error.missing_cfg_file or "").rpartition("/")
    if not error.options:
        return _get_first_line(error)
    hint, options = suggest(option, error.options), ", ".join(error.options)
    return f"{group}={option}: no such option; {hint}must be one of {options}"


def _explain_type_error(error: OmegaConfBaseException, override: str | None) -> str:
    name = str(error.full_key or override)
    schema = error.object_type
    if not dataclasses.is_dataclass(schema) and ("SourceConfig" in str(error) or name.startswith(SOURCES)):
        return f"{SOURCES}: must be set in a custom config file (docs/guides/checks.md)"
    no_key = isinstance(error, ConfigAttributeError | ConfigKeyError)
    if no_key and not isinstance(error, InterpolationKeyError):
        if dataclasses.is_dataclass(schema):
            return describe_unknown_key(name, [field.name for field in dataclasses.fields(schema)])
        known = list(map(str, error.parent_node or ()))
        return f"{describe_unknown_key(name, known)}; + in front of the key adds it"
    if isinstance(error, ValidationError):
        shown = override if override and override.lstrip("+").startswith(f"{name}=") else name
        return f"{shown}: expected {_describe_expected(name, schema, error)}"
    if isinstance(error, ConfigTypeError):
        return f"{name}: cannot be removed; set {name}=VALUE"
    return f"{override or name}: {_get_first_line(error)}"


def _describe_expected(name: str, schema: Any, error: OmegaConfBaseException) -> str:
    if not dataclasses.is_dataclass(schema):
        return f"{_describe_type(error.ref_type)} ({_get_first_line(error)})"
    own = name.split(".")[-1]
    hint = get_type_hints(schema).get(own, Any)
    rule = next((one.metadata.get("rule") for one in dataclasses.fields(schema) if one.name == own), None)
    return _describe_type(hint) if rule is None else f"{_describe_type(hint)}, {rule.words}"


def _describe_type(hint: Any) -> str:
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(_describe_type(part) for part in parts))
    if origin is list:
        return f"a list, each item {_describe_type(parts[0])}"
    if dataclasses.is_dataclass(hint):
        return "a group of " + ", ".join(field.name for field in dataclasses.fields(hint))
    return WORDS.get(hint, str(getattr(hint, "__name__", hint)))


def _get_first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), "") or type(error).__name__
