"""The registry: components are declared where they are defined, and found by slot and name.

A component without keys is a class decorated with `component`. For a component with keys, the decorated class
is a dataclass with these keys. It extends `Settings`, and its name ends in "Settings".

Settings are read without importing their module, since that would import torch. Only the module's constants,
its settings and the settings that it imports are executed. So settings may use only these,
`memmlp.common.settings`, `dataclasses`, `typing`, `collections.abc` and `math`.
"""

from __future__ import annotations
import __future__

import ast
import copy
import functools
import importlib
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, TypeVar

from memmlp.common.errors import InputError
from memmlp.common.settings import Settings, one_of

DECORATOR = re.compile(r'^@component\(\s*"(\w+)",\s*"(\w+)"([^)]*)\)', re.MULTILINE)
PLAIN = re.compile(r"dataclasses|typing|collections\.abc|math|memmlp\.common\.components|(.+\.)?settings")
"""The modules that are really imported when declarations are read."""

SLOTS = (
    "model", "memory", "predictor", "rollout", "loss", "hand", "term", "refiner", "prerequisite", "optim",
)  # fmt: skip
"""The config groups from which a network and its training are composed."""

_Kind = TypeVar("_Kind", bound=Callable[..., Any])
_roots: dict[str, Path] = {"memmlp": Path(__file__).parent.parent}


def component(
    slot: str, name: str, *, version: int = 1, builds: str | None = None
) -> Callable[[_Kind], _Kind]:
    """Declare a component, by decorating its settings or its class.

    All arguments must be literals, since they are read as text.

    Args:
        slot: the config group.
        name: the component's name in the config; it is part of run ids.
        version: the component version. Raise it when the component's results change, so that its runs are
            repeated.
        builds: the name of the class to build, in the same module; None for the decorated class. The class
            gets either the argument `settings` or the keys as arguments.
    """

    def declare(kind: _Kind) -> _Kind:
        kind.option = f"{slot}={name}"  # type: ignore[attr-defined]
        if isinstance(kind, type) and issubclass(kind, Settings):
            if "__dataclass_fields__" not in vars(kind):
                dataclass(kind)
            fields = kind.__dataclass_fields__
            fields["name"] = spec = copy.copy(fields["name"])
            spec.default, spec.metadata = name, MappingProxyType({"rule": one_of(name)})
            kind.name = name
        return kind

    return declare


@dataclass(frozen=True)
class Component:
    """A declared component: `builds` is the name of the class to build, None for the decorated class;
    `package` is "memmlp" or a user's package; `path` is the file of the `module` that declares it."""

    slot: str
    name: str
    version: int
    builds: str | None
    package: str
    module: str
    path: Path

    @property
    def settings(self) -> type[Settings]:
        """The settings class, read without importing the module."""
        space = read_declarations(self.module, self.path)
        if (settings := _find_decorated(space, self)) is None:  # it has no keys
            label = f"{self.slot}_{self.name}"
            settings = dataclass(type(label, (Settings,), {"__module__": space["__name__"]}))
            space[label] = component(self.slot, self.name)(settings)
        return settings

    @property
    def kind(self) -> type:
        """The class to build; reading this property imports its module."""
        module = importlib.import_module(self.module)
        return getattr(module, self.builds) if self.builds else _find_decorated(vars(module), self)

    def build(self, node: Mapping[str, Any], *args: Any, **kwargs: Any) -> Any:
        """Build the component from its keys in the config and further arguments. A class with the parameter
        `settings` gets the keys in an object. Other classes get them as arguments."""
        if self.builds and "settings" in inspect.signature(self.kind).parameters:
            return self.kind(*args, settings=self.make_settings(node), **kwargs)
        return self.kind(*args, **{key: value for key, value in node.items() if key != "name"}, **kwargs)

    def make_settings(self, node: Mapping[str, Any]) -> Any:
        """Return the settings with the values of a config; this imports the component's module."""
        kind: Any = _find_decorated(vars(importlib.import_module(self.module)), self)
        return kind(**{key: value for key, value in node.items() if key != "name"})


def find_component(slot: str, name: str) -> Component:
    """Return the component with a name in a slot. Raises InputError if no package in use declares it."""
    try:
        return collect_components()[slot, name]
    except KeyError:
        raise InputError(
            f"{slot}={name}: must be {' or '.join(list_component_names(slot)) or 'an option of a plugin'}"
        ) from None


def list_component_names(slot: str) -> list[str]:
    """Return a slot's component names in alphabetical order."""
    return sorted(name for group, name in collect_components() if group == slot)


def find_chosen_settings(config: Mapping[str, Any], slot: str) -> type[Settings] | None:
    """Return the settings class of the component in a config's slot; None if the slot is empty."""
    node = config.get(slot)
    return find_component(slot, node["name"]).settings if node else None


def collect_attribute(kind: type[Settings], attribute: str) -> dict[str, Any]:
    """Return the attribute `defaults` or `recipe`, merged over a settings class and its base classes."""
    own = [vars(base).get(attribute, {}) for base in reversed(kind.__mro__)]
    return {key: value for each in own for key, value in each.items()}


@functools.cache
def collect_components() -> dict[tuple[str, str], Component]:
    """Return all components by slot and name. Raises InputError if two packages declare the same option."""
    components: dict[tuple[str, str], Component] = {}
    for package, root in _roots.items():
        for path in sorted(root.rglob("*.py")) if root.is_dir() else [root]:
            for one in _parse_components(package, path):
                if other := components.get((one.slot, one.name)):
                    raise InputError(
                        f"{path}: {one.slot}={one.name} exists already in {other.path}; rename one of them"
                    )
                components[one.slot, one.name] = one
    return components


def add_package(package: str, root: Path | None) -> None:
    """Add the components of a user's package: a folder or a file. If `root` is None, remove them. Raises
    InputError if the package declares an option that already exists."""
    _roots.pop(package, None)
    if root:
        _roots[package] = root
    collect_components.cache_clear()
    try:
        collect_components()
    except InputError:
        _roots.pop(package, None)
        collect_components.cache_clear()
        raise


def _parse_components(package: str, path: Path) -> Iterable[Component]:
    if b"\n@component(" not in (content := path.read_bytes()):
        return
    root = _roots[package]
    below = path.relative_to(root).with_suffix("").parts if path != root else ()
    module = ".".join([package, *(part for part in below if part != "__init__")])
    for slot, name, more in DECORATOR.findall(content.decode()):
        version, builds = re.search(r"version=(\d+)", more), re.search(r'builds="(\w+)"', more)
        number = int(version[1]) if version else 1
        yield Component(slot, name, number, builds[1] if builds else None, package, module, path)


@functools.cache
def read_declarations(module: str, path: Path) -> dict[str, Any]:
    """Execute the declarations in a module's file without importing the module, and return them by name.
    Raises InputError if a declaration needs more than this module's docstring allows."""
    space = ModuleType(f"{module}:declarations")
    sys.modules[space.__name__] = space  # where dataclasses and OmegaConf look up annotations
    kept: list[ast.stmt] = []
    for node in ast.parse(path.read_text(encoding="utf-8"), str(path)).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module != "__future__":
            if PLAIN.fullmatch(node.module):
                kept.append(node)
            elif any(one.name.endswith("Settings") for one in node.names):
                vars(space).update(_read_imported_settings(node))
        elif (isinstance(node, ast.ClassDef) and node.name.endswith("Settings")) or _is_constant(node):
            kept.append(node)
    code = compile(ast.Module(kept, []), str(path), "exec", __future__.annotations.compiler_flag, True)
    try:
        exec(code, vars(space))
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: cannot read the declaration of a component ({reason})") from error
    return vars(space)


def _read_imported_settings(node: ast.ImportFrom) -> dict[str, Any]:
    module = str(node.module)
    for package, root in _roots.items():
        path = root.joinpath(*module.removeprefix(f"{package}.").split(".")).with_suffix(".py")
        if module.startswith(f"{package}.") and path.is_file():
            theirs = read_declarations(module, path)
            return {one.asname or one.name: theirs[one.name] for one in node.names if one.name in theirs}
    return {}


def _is_constant(node: ast.stmt) -> bool:
    if not (isinstance(node, ast.Assign | ast.AnnAssign) and node.value):
        return False
    try:
        ast.literal_eval(node.value)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return False
    return True


def _find_decorated(namespace: Mapping[str, Any], one: Component) -> Any:
    """Return the object in a module's namespace that declares the component; None without one."""
    option = f"{one.slot}={one.name}"
    return next(
        (one for one in namespace.values() if getattr(one, "__dict__", {}).get("option") == option), None
    )
