"""Checks of a composed config before anything runs; each error is one line that names the key."""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Iterator, Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from memmlp.common.components import SLOTS, chosen
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
        for problem in settings.problems(cfg) if (settings := chosen(cfg, slot)) else ():
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
    """Yield which values cannot be combined, as far as no component says so."""
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
