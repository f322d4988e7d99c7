"""The shipped folders of configs and sweeps, and users' packages with custom components.

A package is in use where the user's command (`plugins=[NAME]`, `--plugins NAME`) or script (`load_run(ID,
plugins=[NAME])`), a sweep's base, the environment (MEMMLP_PLUGINS) or an installed entry point of the group
`memmlp.plugins` names it. Reading a run uses no package by itself: a run's folder may come from anybody, and
any module on the path, even a script in the current folder, could be executed.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import pkgutil
import re
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

import memmlp
from memmlp.common.components import SLOTS, Component, add_package, collect_components, find_component
from memmlp.common.errors import InputError
from memmlp.common.overrides import parse_overrides
from memmlp.common.settings import MetricSettings
from memmlp.evaluation.metric_facts import HIGHER, SMALLEST, UNITS

GROUP = "memmlp.plugins"
VARIABLE = "MEMMLP_PLUGINS"
KEY = "plugins"
OWN = "command-line"  # Hydra's name for the folder of `--config-dir`
NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")

_active: dict[str, Path] = {}
_own: ContextVar[Path | None] = ContextVar("config_dir", default=None)


def activate(names: Iterable[str] = ()) -> None:
    """Use packages: the named ones, those in the environment, and installed ones with an entry point.

    Raises:
        InputError: if there is no such package, or it declares something wrong; the message names it.
    """
    for name in (*installed(), *split_names(os.environ.get(VARIABLE, "")), *names):
        if name not in _active:
            _use(name)


@functools.cache
def installed() -> tuple[str, ...]:
    """Return the packages that installed distributions name as entry points of the group."""
    return tuple(dict.fromkeys(entry.module for entry in metadata.entry_points(group=GROUP)))


def split_names(text: str) -> list[str]:
    """Return the names in a text, which are separated by commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def find_named(words: Iterable[str]) -> list[str]:
    """Return the packages that overrides such as `plugins=[mine]` name."""
    values = [one.value or "" for one in parse_overrides(words) if one.key == KEY]
    found: list[str] = []
    for value in values:
        try:
            content = yaml.safe_load(value)
        except yaml.YAMLError:  # composing reports it
            continue
        found += [str(name) for name in content] if isinstance(content, list) else []
    return found


def active() -> Mapping[str, Path]:
    """Return the packages in use, with their folders or files."""
    return _active


def folders() -> list[tuple[str, Path]]:
    """Return the further folders of configs that are searched: those of packages, by name, and the user's."""
    own = _own.get()
    found = [(name, root / "conf") for name, root in _active.items() if (root / "conf").is_dir()]
    return [*found, *([(OWN, own)] if own else [])]


@contextmanager
def search_folder(folder: Path | None) -> Iterator[None]:
    """Search a folder of the user's own configs, that of `--config-dir`, within the context."""
    token = _own.set(folder.absolute() if folder else None)
    try:
        yield
    finally:
        _own.reset(token)


def config_dir_words() -> list[str]:
    """Return `--config-dir FOLDER` for a command that should search the same folder, or nothing."""
    own = _own.get()
    return ["--config-dir", str(own)] if own else []


def _use(name: str) -> None:
    """Find a package, and add its components and metrics; it is imported when a component is built."""
    root = _root(name)
    try:
        add_package(name, root)
        for (slot, option), one in collect_components().items():
            if one.package == name and slot == "metric":
                _add_metric(option, one)
        for fault in _hidden(root):
            raise InputError(fault)
    except InputError as error:
        add_package(name, None)
        raise InputError(f"plugin {name}: {error}") from None
    _active[name] = root


def _root(name: str) -> Path:
    if not NAME.fullmatch(name) or name.split(".")[0] in ("memmlp", *sys.stdlib_module_names):
        raise InputError(f"plugins: '{name}': must be the name of your own package")
    try:
        spec = importlib.util.find_spec(name)
    except ModuleNotFoundError:
        spec = None
    except Exception as error:  # a package around it
        raise InputError(f"plugin {name}: cannot be imported: {type(error).__name__}: {error}") from error
    if spec is None:
        raise InputError(f"plugin {name}: not found; install it, or put its folder on PYTHONPATH")
    return Path(next(iter(spec.submodule_search_locations or ()), spec.origin or ""))


def _add_metric(name: str, one: Component) -> None:
    from memmlp.sweep.definition import COSTS

    facts: Any = one.settings
    if name in UNITS or name in COSTS:
        raise InputError(f"metric {name}: must have another name, since there is one of that name")
    if not issubclass(facts, MetricSettings) or facts.smallest <= 0:
        raise InputError(f"metric {name}: needs MetricSettings with `smallest` above 0")
    if facts.better not in ("lower", "higher") or facts.of not in ("positions", "rotations"):
        raise InputError(f"metric {name}: better must be lower or higher, and of positions or rotations")
    UNITS[name], SMALLEST[name] = facts.unit, facts.smallest
    if facts.better == "higher":
        HIGHER.add(name)


def _hidden(root: Path) -> Iterator[str]:
    """Yield the package's options with the name of one of memmlp's or of another package."""
    others = [packaged("conf"), *(folder / "conf" for folder in _active.values())]
    for path in sorted((root / "conf").rglob("*.yaml")):
        option = path.relative_to(root / "conf")
        taken = any((other / option).exists() for other in others)
        if taken or is_component(option):
            yield f"{path}: must have another name, since there is an option of that name"


def is_component(option: Path) -> bool:
    """Return whether memmlp has a component with the group and the name of a config file."""
    found = collect_components().get((option.parent.as_posix(), option.stem))
    return found is not None and found.package == "memmlp"


def find_used(config: Mapping[str, Any]) -> list[str]:
    """Return the packages of a config's components and metrics, except memmlp."""
    options = [(slot, config[slot]["name"]) for slot in SLOTS if config.get(slot)]
    options += [("metric", name) for name in config["evaluation"].get("metrics") or ()]
    options.append(("coordinates", config["normalizer"]["coordinates"]))
    if config["data"].get("synth"):
        options.append(("generator", config["data"]["synth"]["name"]))
    options += [("loggers", name) for name in config.get("loggers") or ()]
    return sorted({find_component(slot, name).package for slot, name in options} - {"memmlp"})


def check_allowed(config: Mapping[str, Any], recorded: Mapping[str, Any], where: str) -> None:
    """Check that the packages of a recorded config are in use.

    Args:
        config: the config.
        recorded: the recorded facts about the packages that made the run, by name.
        where: what the config belongs to, for the error.

    Raises:
        InputError: one line that names the package, and what to do.
    """
    for name in config.get(KEY) or ():
        if name not in _active:
            version = (recorded.get(name) or {}).get("version")
            shown = f"{name} {version}" if version else name
            if not NAME.fullmatch(name) or importlib.util.find_spec(name.split(".")[0]) is None:
                found = f"{where}: made with the package {shown}, which is not found"
                raise InputError(f"{found}; install it, or put its folder on PYTHONPATH")
            ways = f"--plugins {name} or {VARIABLE}={name}, in Python plugins=['{name}']"
            raise InputError(f"{where}: needs code of the package {shown}; to trust it, use {ways}")


def import_object(path: str, key: str) -> Any:
    """Return the class or function at a dotted path. Raises InputError, naming the key, for a missing one."""
    try:
        return pkgutil.resolve_name(path)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(f"{key}: {path}: {str(error).splitlines()[0]}") from error


DEFAULT_GROUPING = "cmu"  # the grouping of data=mocap


def packaged(name: str) -> Path:
    """Return the folder `conf` or `sweeps`.

    In a checkout, the folder is beside the package. In an installed package, it is inside, named `_conf` or
    `_sweeps`.
    """
    package = Path(memmlp.__file__).resolve().parent
    installed = package / f"_{name}"
    return installed if installed.is_dir() else package.parent / name


def grouping_to_choose(names: Collection[str]) -> str | None:
    """Return the shipped grouping that `data=mocap` needs for these clips; None if it has the right one.

    Args:
        names: clips' names below their folder, without `.npz`.
    """
    fitting = {
        path.stem
        for path in (packaged("conf") / "data" / "grouping").glob("*.yaml")
        for pattern in yaml.safe_load(path.read_text(encoding="utf-8"))["groups"]
        if any(re.search(pattern, name) for name in names)
    }
    return None if DEFAULT_GROUPING in fitting else min(fitting, default=None)
