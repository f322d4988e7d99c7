"""The registry: components are declared where they are defined, and found by slot and name.

A component without keys is a class decorated with `component`. The keys of any other component are a
dataclass that extends `Settings`, whose name ends in "Settings", decorated in place of the class. This
dataclass is read without importing its module, since that imports torch: only the module's constants, its
settings and the settings that it imports are executed. So settings may use no more than these,
`memmlp.common.settings`, and what `dataclasses`, `typing`, `collections.abc` and `math` have.
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
"""The modules that declarations may import as they are."""

SLOTS = (
    "model",
    "memory",
    "predictor",
    "rollout",
    "loss",
    "hand",
    "term",
    "refiner",
    "prerequisite",
    "optim",
)
"""The groups of the config with components of the network and its training as options."""

_Kind = TypeVar("_Kind", bound=Callable[..., Any])
_roots: dict[str, Path] = {"memmlp": Path(__file__).parent.parent}


def component(
    slot: str, name: str, *, version: int = 1, builds: str | None = None
) -> Callable[[_Kind], _Kind]:
    """Declare a component by its settings or its class; all arguments are literals, which are read as text.

    Args:
        slot: the group of the config.
        name: the component's name in the config, which enters the id of runs.
        version: the component version, to be raised when the component's results change: then its runs are
            made again.
        builds: the name of the class in the same module that is built, either with the argument `settings`
            or with the keys as arguments; None if it is the decorated class.
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
    """A declared component.

    Attributes:
        slot: the group of the config.
        name: the component's name in the config.
        version: the component version.
        builds: the class that is built; None for the settings' class itself.
        package: the package that it belongs to: "memmlp" or a user's.
        module: the module that declares it.
        path: the module's file.
    """

    slot: str
    name: str
    version: int
    builds: str | None
    package: str
    module: str
    path: Path

    @property
    def settings(self) -> type[Settings]:
        """The class of the settings, read without importing the module."""
        space = read_declarations(self.module, self.path)
        if (found := _of_option(space, self)) is None:  # it has no keys
            label = f"{self.slot}_{self.name}"
            found = dataclass(type(label, (Settings,), {"__module__": space["__name__"]}))
            space[label] = component(self.slot, self.name)(found)
        return found

    @property
    def kind(self) -> type:
        """The class that is built; its module is imported."""
        module = importlib.import_module(self.module)
        return getattr(module, self.builds) if self.builds else _of_option(vars(module), self)

    def build(self, node: Mapping[str, Any], *given: Any, **more: Any) -> Any:
        """Build the component from its keys in the config, besides the arguments given.

        A class that has the parameter `settings` takes the keys as an object, others as arguments.
        """
        if self.builds and "settings" in inspect.signature(self.kind).parameters:
            return self.kind(*given, settings=self.make_settings(node), **more)
        return self.kind(*given, **{key: value for key, value in node.items() if key != "name"}, **more)

    def make_settings(self, node: Mapping[str, Any]) -> Any:
        """Return the settings as an object of the imported module's class, with the values of a config."""
        kind: Any = _of_option(vars(importlib.import_module(self.module)), self)
        return kind(**{key: value for key, value in node.items() if key != "name"})


def find(slot: str, name: str) -> Component:
    """Return a component.

    Raises:
        InputError: if no package in use has it.
    """
    try:
        return declared()[slot, name]
    except KeyError:
        raise InputError(
            f"{slot}={name}: must be {' or '.join(names(slot)) or 'an option of a plugin'}"
        ) from None


def names(slot: str) -> list[str]:
    """Return the names of the components of a slot, in alphabetical order."""
    return sorted(name for group, name in declared() if group == slot)


def chosen(config: Mapping[str, Any], slot: str) -> type[Settings] | None:
    """Return the settings' class of the component that a config has in a slot; None if the slot is empty."""
    node = config.get(slot)
    return find(slot, node["name"]).settings if node else None


def collect_attribute(kind: type[Settings], attribute: str) -> dict[str, Any]:
    """Return `defaults` or `recipe` of a settings' class together with those of its bases."""
    own = [vars(base).get(attribute, {}) for base in reversed(kind.__mro__)]
    return {key: value for each in own for key, value in each.items()}


@functools.cache
def declared() -> dict[tuple[str, str], Component]:
    """Return all components by slot and name, those of users' packages in use included.

    Raises:
        InputError: if two packages declare the same option.
    """
    found: dict[tuple[str, str], Component] = {}
    for package, root in _roots.items():
        for path in sorted(root.rglob("*.py")) if root.is_dir() else [root]:
            for one in _in_file(package, path):
                if other := found.get((one.slot, one.name)):
                    raise InputError(
                        f"{path}: {one.slot}={one.name}: {other.path} has an option of that name"
                    )
                found[one.slot, one.name] = one
    return found


def add_package(package: str, root: Path | None) -> None:
    """Add the components of a user's package, in a folder or in one file; None takes them away again.

    Raises:
        InputError: if it declares an option that exists.
    """
    _roots.pop(package, None)
    if root:
        _roots[package] = root
    declared.cache_clear()
    try:
        declared()
    except InputError:
        _roots.pop(package, None)
        declared.cache_clear()
        raise


def _in_file(package: str, path: Path) -> Iterable[Component]:
    text = path.read_text(encoding="utf-8")
    if "\n@component(" not in text:
        return
    root = _roots[package]
    below = path.relative_to(root).with_suffix("").parts if path != root else ()
    module = ".".join([package, *(part for part in below if part != "__init__")])
    for slot, name, more in DECORATOR.findall(text):
        version, builds = re.search(r"version=(\d+)", more), re.search(r'builds="(\w+)"', more)
        number = int(version[1]) if version else 1
        yield Component(slot, name, number, builds[1] if builds else None, package, module, path)


@functools.cache
def read_declarations(module: str, path: Path) -> dict[str, Any]:
    """Return the declarations of a module's file by name, executed without importing the module.

    Raises:
        InputError: if a declaration needs more than the module docstring allows.
    """
    space = ModuleType(f"{module}:declarations")
    sys.modules[space.__name__] = space  # where dataclasses and OmegaConf look up annotations
    kept: list[ast.stmt] = []
    for node in ast.parse(path.read_text(encoding="utf-8"), str(path)).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module != "__future__":
            if PLAIN.fullmatch(node.module):
                kept.append(node)
            elif any(one.name.endswith("Settings") for one in node.names):
                vars(space).update(_imported(node))
        elif (isinstance(node, ast.ClassDef) and node.name.endswith("Settings")) or _is_constant(node):
            kept.append(node)
    code = compile(ast.Module(kept, []), str(path), "exec", __future__.annotations.compiler_flag, True)
    try:
        exec(code, vars(space))
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: a component's declaration cannot be read: {reason}") from error
    return vars(space)


def _imported(node: ast.ImportFrom) -> dict[str, Any]:
    """Return the settings' classes that a statement imports from another module with declarations."""
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


def _of_option(found: Mapping[str, Any], one: Component) -> Any:
    """Return the component's decorated object among the names of its module; None without one."""
    option = f"{one.slot}={one.name}"
    return next(
        (kind for kind in found.values() if getattr(kind, "__dict__", {}).get("option") == option), None
    )
