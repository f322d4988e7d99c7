"""The modules of the user's own that others of these import, found by reading code; nothing is imported."""

from __future__ import annotations

import ast
import importlib.util
import sys
from collections.abc import Iterator, Mapping
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

INSTALLED = ("site-packages", "dist-packages")
"""Folders of installed packages, which are known by their versions."""

NOT_OWN = ("memmlp", "torch", "numpy", *sys.stdlib_module_names)
"""Modules that are nobody's own, wherever they lie."""


def imported_modules(modules: Mapping[str, Path]) -> dict[str, Path]:
    """Return the files of the modules of the user's own that some modules import, at whatever remove.

    Modules of memmlp, of the standard library and of installed packages are left out. What is imported by a
    name that the code computes (`importlib.import_module`) is not found.

    Args:
        modules: the files to begin with, by the dotted names of the modules; they are not returned.
    """
    found: dict[str, Path] = {}
    left = dict(modules)
    while left:
        for module in _imported(*left.popitem()):
            if module not in found and module not in modules and (file := _own_file(module)):
                found[module] = left[module] = file
    return dict(sorted(found.items()))


def _imported(module: str, file: Path) -> Iterator[str]:
    """Yield dotted names that a module may import, with their parents; some may be no modules."""
    yield from _parents(module)
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):  # not Python of this version: an extension module, for one
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            source = _source(node, module, file)
            names = [f"{source}.{alias.name}".strip(".") for alias in node.names]
        else:
            continue
        for name in names:
            yield from (*_parents(name), name)


def _parents(module: str) -> list[str]:
    """Return the packages above a module, whose code runs before its own."""
    parts = module.split(".")
    return [".".join(parts[:count]) for count in range(1, len(parts))]


def _source(node: ast.ImportFrom, module: str, file: Path) -> str:
    """Return the dotted name of the module from which a statement in a module imports."""
    if not node.level:
        return node.module or ""
    package = module.split(".") if file.name == "__init__.py" else module.split(".")[:-1]
    above = package[: len(package) - node.level + 1]
    return ".".join([*above, *([node.module] if node.module else [])])


def _own_file(module: str) -> Path | None:
    """Return the file of a module of the user's own; None if there is none, or if it is not the user's."""
    spec = module_spec(module)
    if spec is None or not spec.has_location or not spec.origin:  # such as a folder without __init__.py
        return None
    file = Path(spec.origin)
    return file if file.is_file() and not set(INSTALLED) & set(file.parts) else None


def module_spec(module: str) -> ModuleSpec | None:
    """Return where a module lies, without importing it or its parents; None for one that is nobody's own.

    One that is imported lies where it was imported from.
    """
    top, *rest = module.split(".")
    try:
        spec = None if top in NOT_OWN else importlib.util.find_spec(top)
    except ValueError:  # a module that was made by hand
        return None
    for part in rest:
        if spec is None or spec.submodule_search_locations is None:
            return None
        # By its last name alone: with the whole, a folder without __init__.py needs its parent imported.
        spec = PathFinder.find_spec(part, list(spec.submodule_search_locations))
    return spec
