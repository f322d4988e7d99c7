"""Plugins (users' packages with custom components), and the shipped folders of configs and sweeps.

A package is in use if one of these names it:

- the command (`plugins=[NAME]`, `--plugins NAME`) or the script (`load_run(ID, plugins=[NAME])`);
- the base of a sweep or search;
- the environment variable MEMMLP_PLUGINS;
- an installed entry point of the group `memmlp.plugins`.

A run's config does not activate packages, for security: a run's folder may come from anyone, and any module
on the path could be executed.
"""

import functools
import importlib.util
import os
import pkgutil
import re
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from memmlp.common.components import SLOTS, Component, add_package, collect_components, find_component
from memmlp.common.errors import InputError
from memmlp.common.files import find_packaged_folder
from memmlp.common.overrides import parse_overrides
from memmlp.common.schema import parse_config_yaml
from memmlp.common.settings import MetricSettings
from memmlp.evaluation.metric_facts import HIGHER, SMALLEST, UNITS

GROUP = "memmlp.plugins"
VARIABLE = "MEMMLP_PLUGINS"
KEY = "plugins"
OWN = "command-line"  # Hydra's name for the folder of `--config-dir`
NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")

_active: dict[str, Path] = {}
_own: ContextVar[Path | None] = ContextVar("config_dir", default=None)


def activate(names: Iterable[str] = ()) -> None:
    """Activate packages: the named ones, and packages from the environment and from entry points. Raises
    InputError for a package that does not exist or has an invalid declaration."""
    for name in (*list_installed(), *split_names(os.environ.get(VARIABLE, "")), *names):
        if name not in _active:
            _use_package(name)


@functools.cache
def list_installed() -> tuple[str, ...]:
    """Return the packages that installed distributions declare as entry points."""
    return tuple(dict.fromkeys(entry.module for entry in metadata.entry_points(group=GROUP)))


def split_names(text: str) -> list[str]:
    """Split a text of comma-separated names."""
    return [name.strip() for name in text.split(",") if name.strip()]


def find_named_packages(words: Iterable[str]) -> list[str]:
    """Return the packages in overrides such as `plugins=[mine]`."""
    values = [one.value or "" for one in parse_overrides(words) if one.key == KEY]
    packages: list[str] = []
    for value in values:
        with suppress(yaml.YAMLError):  # reported when the config is composed
            content = parse_config_yaml(value)
            packages += map(str, content) if isinstance(content, list) else []
    return packages


def list_active() -> Mapping[str, Path]:
    """Return the folder or file of each package in use, by name."""
    return _active


def list_config_folders() -> list[tuple[str, Path]]:
    """Return the custom config folders, each with its plugin's name, or with OWN for `--config-dir`."""
    own = _own.get()
    plugin_folders = [(name, root / "conf") for name, root in _active.items() if (root / "conf").is_dir()]
    return [*plugin_folders, *([(OWN, own)] if own else [])]


@contextmanager
def search_folder(folder: Path | None) -> Iterator[None]:
    """Search the folder of `--config-dir` for configs, within the context."""
    token = _own.set(folder.absolute() if folder else None)
    try:
        yield
    finally:
        _own.reset(token)


def format_config_dir() -> list[str]:
    """Return the arguments `--config-dir FOLDER` for another command; empty without the option."""
    own = _own.get()
    return ["--config-dir", str(own)] if own else []


def _use_package(name: str) -> None:
    """Add a package's components and metrics. It is imported only when a component is built."""
    root = _find_root(name)
    try:
        add_package(name, root)
        for (slot, option), one in collect_components().items():
            if one.package == name and slot == "metric":
                _add_metric(option, one)
        for fault in _find_hidden_options(root):
            raise InputError(fault)
    except InputError as error:
        add_package(name, None)
        raise InputError(f"plugin {name}: {error}") from None
    _active[name] = root


def _find_root(name: str) -> Path:
    if not NAME.fullmatch(name) or name.split(".")[0] in ("memmlp", *sys.stdlib_module_names):
        raise InputError(f"plugins=[{name}]: must be the name of a custom package")
    try:
        spec = importlib.util.find_spec(name)
    except ModuleNotFoundError:
        spec = None
    except Exception as error:  # a parent package failed
        raise InputError(f"plugin {name}: cannot be imported: {type(error).__name__}: {error}") from error
    if spec is None:
        raise InputError(f"plugin {name}: not found; install it, or put its folder on PYTHONPATH")
    return Path(next(iter(spec.submodule_search_locations or ()), spec.origin or ""))


def _add_metric(name: str, one: Component) -> None:
    from memmlp.sweep.definition import COSTS

    facts: Any = one.settings
    if name in UNITS or name in COSTS:
        raise InputError(f"metric {name}: already exists; rename the custom metric")
    if not issubclass(facts, MetricSettings) or facts.smallest <= 0:
        raise InputError(f"metric {name}: expected MetricSettings with `smallest` above 0")
    if facts.better not in ("lower", "higher") or facts.of not in ("positions", "rotations"):
        raise InputError(f"metric {name}: `better` must be lower or higher, `of` positions or rotations")
    UNITS[name], SMALLEST[name] = facts.unit, facts.smallest
    if facts.better == "higher":
        HIGHER.add(name)


def _find_hidden_options(root: Path) -> Iterator[str]:
    """Yield an error line for each of a package's config files with an option's name that already exists."""
    others = [find_packaged_folder("conf"), *(folder / "conf" for folder in _active.values())]
    for path in sorted((root / "conf").rglob("*.yaml")):
        option = path.relative_to(root / "conf")
        taken = any((other / option).exists() for other in others)
        if taken or is_component(option):
            yield f"{path}: an option with this name already exists; rename the file"


def is_component(option: Path) -> bool:
    """Return whether a config file has the group and name of one of memmlp's components."""
    component = collect_components().get((option.parent.as_posix(), option.stem))
    return component is not None and component.package == "memmlp"


def find_used_packages(config: Mapping[str, Any]) -> list[str]:
    """Return the packages, except memmlp, of a config's components and metrics."""
    options = [(slot, config[slot]["name"]) for slot in SLOTS if config.get(slot)]
    options += [("metric", name) for name in config["evaluation"].get("metrics") or ()]
    options.append(("coordinates", config["normalizer"]["coordinates"]))
    if config["data"].get("synth"):
        options.append(("generator", config["data"]["synth"]["name"]))
    options += [("loggers", name) for name in config.get("loggers") or ()]
    return sorted({find_component(slot, name).package for slot, name in options} - {"memmlp"})


def check_allowed(config: Mapping[str, Any], recorded: Mapping[str, Any], where: str) -> None:
    """Check that the packages of a config are in use, given their recorded facts. `where` names the config's
    owner, such as "run ID". Raises InputError for a package that is missing or not in use."""
    for name in config.get(KEY) or ():
        if name not in _active:
            version = (recorded.get(name) or {}).get("version")
            shown = f"{name} {version}" if version else name
            if not NAME.fullmatch(name) or importlib.util.find_spec(name.split(".")[0]) is None:
                raise InputError(
                    f"{where}: needs the package {shown}, which was not found; install it, or put its "
                    "folder on PYTHONPATH"
                )
            ways = f"--plugins {name}, {VARIABLE}={name}, or in Python plugins=['{name}']"
            raise InputError(f"{where}: needs code of the package {shown}; if you trust it, use {ways}")


def import_object(path: str, key: str) -> Any:
    """Import the class or function at a dotted path. Raises InputError, which names the key."""
    try:
        return pkgutil.resolve_name(path)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(f"{key}: {path}: {str(error).splitlines()[0]}") from error


DEFAULT_GROUPING = "cmu"  # the grouping of data=mocap


def choose_grouping(names: Collection[str]) -> str | None:
    """Return the shipped grouping that fits these clips (paths without `.npz`) if DEFAULT_GROUPING does not;
    or None."""
    fitting = {
        path.stem
        for path in (find_packaged_folder("conf") / "data" / "grouping").glob("*.yaml")
        for pattern in yaml.safe_load(path.read_text(encoding="utf-8"))["groups"]
        if any(re.search(pattern, name) for name in names)
    }
    return None if DEFAULT_GROUPING in fitting else min(fitting, default=None)
