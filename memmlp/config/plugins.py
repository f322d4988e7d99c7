"""Users' packages with custom components: which are in use, and whose code a run may therefore name.

A package is used where the user's command (`plugins=[NAME]`, `--plugins NAME`) or script (`load_run(ID,
plugins=[NAME])`), a sweep's base, the environment (MEMMLP_PLUGINS) or an installed entry point of the group
`memmlp.plugins` names it. Reading a run imports no package by itself: a run's folder may come from anybody,
and any module on the path (even a script in the current folder) would be executed by an import.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml

from memmlp.common import plugin as known
from memmlp.common.errors import InputError
from memmlp.common.overrides import parse_overrides
from memmlp.common.plugin import Plugin
from memmlp.config.package_data import packaged
from memmlp.evaluation.metric_facts import HIGHER, SMALLEST, UNITS
from memmlp.runs.environment import own_code_digests
from memmlp.runs.identity import flatten
from memmlp.runs.recipe_versions import RECIPES

GROUP = "memmlp.plugins"
VARIABLE = "MEMMLP_PLUGINS"
KEY = "plugins"
OWN = "command-line"  # what Hydra calls the folder of `--config-dir`
NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")

_active: dict[str, Plugin] = {}
_folders: dict[str, Path] = {}
_own: ContextVar[Path | None] = ContextVar("config_dir", default=None)


def activate(names: Iterable[str] = ()) -> None:
    """Use packages: the named ones, those in the environment, and installed ones with an entry point.

    Raises:
        InputError: if a package can't be imported, or declares something wrong; the message names it.
    """
    for name in (*installed(), *in_environment(), *names):
        if name not in _active:
            _use(name)


@functools.cache
def installed() -> tuple[str, ...]:
    """Return the packages that installed distributions name as entry points of the group."""
    return tuple(dict.fromkeys(entry.module for entry in metadata.entry_points(group=GROUP)))


def in_environment() -> list[str]:
    """Return the packages that the environment names."""
    return split_names(os.environ.get(VARIABLE, ""))


def split_names(words: str) -> list[str]:
    """Return the names in a text, which are separated by commas."""
    return [name.strip() for name in words.split(",") if name.strip()]


def named(words: Iterable[str]) -> list[str]:
    """Return the packages that overrides such as `plugins=[mine]` name."""
    values = [one.value or "" for one in parse_overrides(words) if one.key == KEY]
    found: list[str] = []
    for value in values:
        try:
            content = yaml.safe_load(value)
        except yaml.YAMLError:  # composing says what is wrong
            continue
        found += [str(name) for name in content] if isinstance(content, list) else []
    return found


def active() -> Mapping[str, Plugin]:
    """Return the packages in use, by name."""
    return _active


def folders() -> list[tuple[str, Path]]:
    """Return the folders of configs searched beside memmlp's: the packages', by name, and the user's."""
    own = _own.get()
    return [*_folders.items(), *([(OWN, own)] if own else [])]


@contextmanager
def searching(folder: Path | None) -> Iterator[None]:
    """Search a folder of the user's own configs, that of `--config-dir`, within the context."""
    token = _own.set(folder.absolute() if folder else None)
    try:
        yield
    finally:
        _own.reset(token)


def config_dir_words() -> list[str]:
    """Return the words `--config-dir FOLDER` for a command that should search the same folder, or none."""
    own = _own.get()
    return ["--config-dir", str(own)] if own else []


def texts_outside_memmlp() -> list[tuple[str, str]]:
    """Return code and configs from outside memmlp, as (name, text), on which a plan depends."""
    found = [
        (f"{name}:{file}", text)
        for name, files in own_code_digests(_active).items()
        for file, text in files.items()
    ]
    paths = [path for _, folder in folders() for path in sorted(folder.rglob("*.yaml"))]
    return [*found, *((str(path), path.read_text(encoding="utf-8")) for path in paths)]


def _use(name: str) -> None:
    """Import a package, and register everything that it declares."""
    module = _imported(name)
    plugin = getattr(module, "plugin", None)
    plugin = plugin if isinstance(plugin, Plugin) else Plugin()
    for fault in (*known.faults(plugin), *_taken(plugin), *_hidden(module, plugin)):
        raise InputError(f"plugin {name}: {fault}")
    if (folder := _folder(module, plugin)).is_dir():
        _folders[name] = folder
    _add_schemas(name, plugin)
    RECIPES.update(plugin.recipes)
    known.METRICS.update(plugin.metrics)
    for own, metric in plugin.metrics.items():
        RECIPES[f"metric.{own}"], UNITS[own], SMALLEST[own] = metric.recipe, metric.unit, metric.smallest
    HIGHER.update(own for own, metric in plugin.metrics.items() if metric.better == "higher")
    _active[name] = plugin


def _add_schemas(name: str, plugin: Plugin) -> None:
    """Register the schemas of a package's options. Raises InputError for one that does not fit its slot."""
    if not plugin.schemas:
        return
    from memmlp.config.schema import add_schema

    for option, path in plugin.schemas.items():
        module, _, attribute = path.rpartition(".")
        try:
            add_schema(option, getattr(importlib.import_module(module), attribute))
        except (ImportError, AttributeError, ValueError) as error:
            raise InputError(f"plugin {name}: schema of {option}: {path}: {error}") from error


def _imported(name: str) -> ModuleType:
    """Import the package. Raises InputError if it does not exist, or if it raises an error itself."""
    if not NAME.fullmatch(name) or _reserved(name):
        raise InputError(f"plugins: '{name}'; allowed is the name of a package of your own")
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name and (name == error.name or name.startswith(f"{error.name}.")):
            raise InputError(
                f"plugin {name}: there is no such package here; install it, or put its folder on PYTHONPATH"
            ) from None
        raise InputError(f"plugin {name}: cannot be imported: {error}") from error
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"plugin {name}: cannot be imported: {reason}") from error


def _reserved(name: str) -> bool:
    """Return whether a name is memmlp's or the standard library's, such as os."""
    return name.split(".")[0] in ("memmlp", *sys.stdlib_module_names)


def _folder(module: ModuleType, plugin: Plugin) -> Path:
    """Return the folder of the package's configs; a module that is one file has none."""
    return Path(next(iter(getattr(module, "__path__", ())), os.devnull)) / plugin.conf


def _taken(plugin: Plugin) -> Iterator[str]:
    """Yield the declared names that are already taken."""
    from memmlp.sweep.definition import COSTS

    for name in plugin.metrics:
        if name in UNITS or name in COSTS:
            yield f"metric {name}: there is one of that name; allowed is a name of its own"
    for name in plugin.recipes:
        if name in RECIPES:
            yield f"recipe of {name}: there is a component of that name; allowed is a name of its own"


def _hidden(module: ModuleType, plugin: Plugin) -> Iterator[str]:
    """Yield those of the package's options that an option of memmlp or another package would hide."""
    folder = _folder(module, plugin)
    for path in sorted(folder.rglob("*.yaml")):
        option = path.relative_to(folder)
        if any((other / option).exists() for other in (packaged("conf"), *_folders.values())):
            yield f"{path}: there is an option of that name; allowed is a name of its own"


def foreign(config: Mapping[str, Any]) -> list[str]:
    """Return the paths of classes and functions outside memmlp that a config names."""
    flat = flatten(config)
    paths = [str(value) for key, value in flat.items() if key.rsplit(".", 1)[-1] == "_target_"]
    coordinates = str(flat.get("normalizer.coordinates", ""))
    paths += [coordinates] if "." in coordinates else []
    return [path for path in dict.fromkeys(paths) if not path.startswith("memmlp.")]


def owner(path: str) -> str:
    """Return the active package that a dotted path belongs to; otherwise the path's first part."""
    fits = [name for name in _active if path.startswith(f"{name}.")]
    return max(fits, key=len, default=path.split(".")[0])


def used(config: Mapping[str, Any]) -> list[str]:
    """Return the packages of a config's classes and metrics, after a check that they are in use."""
    measured = (config.get("evaluation") or {}).get("metrics") or ()
    paths = [known.METRICS[name].function for name in measured if name in known.METRICS]
    found = sorted({owner(path) for path in [*foreign(config), *paths]})
    activate(found)
    return found


def check_allowed(config: Mapping[str, Any], recorded: Mapping[str, Any], where: str) -> None:
    """Check that the code named in a recorded config may be imported.

    Args:
        config: the config.
        recorded: the recorded facts about the packages that made the run, by name.
        where: what the config belongs to, for the error.

    Raises:
        InputError: one line that names the package, and what to do.
    """
    for path in foreign(config):
        if _reserved(path):
            raise InputError(f"{where}: {path}: allowed is what memmlp or a package of your own defines")
    named_here = [*(config.get(KEY) or ()), *map(owner, foreign(config))]
    for name in dict.fromkeys(named_here):
        if name not in _active:
            raise InputError(f"{where}: {_refusal(str(name), recorded)}")
    for path in foreign(config):
        if not _defined(path, owner(path)):
            raise InputError(f"{where}: {path}: allowed is what {owner(path)} defines itself")


def _defined(path: str, name: str) -> bool:
    """Return whether a package defines what is at a path, and not only imports it, as mine.os.system."""
    from memmlp.config.instantiate import located

    module = getattr(located(path, name), "__module__", "") or ""
    return module.split(".")[0] == name.split(".")[0]


def _refusal(name: str, recorded: Mapping[str, Any]) -> str:
    """Say why a package's code is not imported, and what to do about it."""
    version = (recorded.get(name) or {}).get("version")
    said = f"{name} {version}" if version else name
    if not NAME.fullmatch(name) or importlib.util.find_spec(name.split(".")[0]) is None:
        return f"made with the package {said}, which is not here; install it, or put its folder on PYTHONPATH"
    ways = f"--plugins {name} or {VARIABLE}={name}, in Python plugins=['{name}']"
    return f"names code of the package {said}; to trust it, say {ways}"
