"""The modules of the user's own that others of these import, found by reading code; nothing is imported."""

from __future__ import annotations

import ast
import importlib.util
import sys
from collections.abc import Collection, Iterator, Mapping
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import NamedTuple

INSTALLED = ("site-packages", "dist-packages")
"""Folders of installed packages, which are known by their versions."""

NOT_OWN = ("memmlp", "torch", "numpy", *sys.stdlib_module_names)
"""Modules that are nobody's own, wherever they lie."""

BY_NAME = ("import_module", "__import__", "run_module")
"""Functions that run the code of the module whose name is their first argument."""

OTHERWISE = ("spec_from_file_location", "exec_module", "load_module", "run_path")
"""Functions that run code of which reading a call tells nothing, as `exec` does."""


def imported_modules(modules: Mapping[str, Path]) -> dict[str, Path]:
    """Return the files of the modules of the user's own that some modules import, at whatever remove.

    Modules of memmlp, of the standard library and of installed packages are left out. What is imported by a
    name that the code computes is not found (`imports_by_computed_names`).

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


def imports_by_computed_names(module: str, file: Path, packages: Collection[str]) -> bool:
    """Return whether a module runs code of the user's own that it names by what it computes.

    Such code can't be told by reading: `importlib.import_module(f"lab.{name}")`.

    Args:
        module: the module's dotted name.
        file: its file.
        packages: packages all of whose files are known, so that any module of them may be named.
    """
    return any(not _is_known(name, packages) for name in _called(module, file))


def _is_known(name: Written, packages: Collection[str]) -> bool:
    """Return whether all code is known that a call with this name may run, or none of it is the user's."""
    if name.whole or any(name.text.startswith(f"{package}.") for package in packages):
        return True
    top, point, _ = name.text.partition(".")
    return bool(point and top) and not _may_be_own(top)


def _may_be_own(top: str) -> bool:
    """Return whether a package on the path is the user's own."""
    spec = module_spec(top)
    places = [*(spec.submodule_search_locations or ()), spec.origin or ""] if spec else []
    return spec is not None and not any(set(INSTALLED) & set(Path(place).parts) for place in places)


def _imported(module: str, file: Path) -> Iterator[str]:
    """Yield dotted names that a module may import, with their parents; some may be no modules."""
    yield from _parents(module)
    for node in _nodes(file):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            source = _source(node, module, file)
            names = [f"{source}.{alias.name}".strip(".") for alias in node.names]
        else:
            continue
        for name in names:
            yield from (*_parents(name), name)
    for called in _called(module, file):
        if called.whole:
            yield from (*_parents(called.text), called.text)


def _nodes(file: Path) -> Iterator[ast.AST]:
    """Yield the nodes of a file's code; none if it is not Python of this version, as an extension module."""
    try:
        yield from ast.walk(ast.parse(file.read_bytes()))
    except (SyntaxError, ValueError):
        return


class Written(NamedTuple):
    """What code says of a text that it makes.

    Attributes:
        text: the text, as far as it is written out from its beginning.
        whole: whether nothing follows.
    """

    text: str
    whole: bool


UNKNOWN = Written("", False)


def _called(module: str, file: Path) -> Iterator[Written]:
    """Yield the dotted names of the modules whose code a module's calls run, as far as they are written."""
    for node in _nodes(file):
        if not isinstance(node, ast.Call):
            continue
        name = getattr(node.func, "id", None) or getattr(node.func, "attr", None)
        if name in BY_NAME:
            yield _absolute(node, module, file)
        elif name in OTHERWISE or getattr(node.func, "id", None) == "exec":
            yield UNKNOWN


def _absolute(node: ast.Call, module: str, file: Path) -> Written:
    """Return the name in a call that imports; a relative one is made absolute."""
    arguments = [*node.args[:2], *(word.value for word in node.keywords if word.arg == "package")]
    if not arguments:
        return UNKNOWN
    name = _written(arguments[0], module, file)
    rest = name.text.lstrip(".")
    if rest == name.text:
        return name
    above = _written(arguments[1], module, file) if len(arguments) > 1 else UNKNOWN
    if not above.whole:
        return UNKNOWN
    parts = above.text.split(".")
    return Written(".".join([*parts[: len(parts) - len(name.text) + len(rest) + 1], rest]), name.whole)


def _written(node: ast.expr, module: str, file: Path) -> Written:
    """Return what an expression says of the text that it makes in a module."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return Written(node.value, True)
    if isinstance(node, ast.Name) and node.id in ("__name__", "__package__"):
        inside = node.id == "__package__" and file.name != "__init__.py"
        return Written(module.rpartition(".")[0] if inside else module, True)
    parts: list[ast.expr] = []
    if isinstance(node, ast.JoinedStr):
        parts = [part.value if isinstance(part, ast.FormattedValue) else part for part in node.values]
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        parts = [node.left, node.right]
    text = ""
    for part in parts:
        found = _written(part, module, file)
        text += found.text
        if not found.whole:
            return Written(text, False)
    return Written(text, bool(parts))


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
