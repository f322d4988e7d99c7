"""The environment of a run: code version, packages and hardware."""

from __future__ import annotations

import ast
import contextlib
import functools
import hashlib
import importlib.util
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from importlib import metadata
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

import memmlp

PACKAGE = Path(memmlp.__file__).parent
NOT_NUMBERS = ("cli", "config", "live", "report", "runs/loggers", "sweep")
"""Folders of the package whose code does not affect results; only `live` measures one, the time of a pose."""
WIRING = ("config/build.py", "config/build_motion.py")
"""Files of these folders that count nevertheless, since they decide what reaches the constructors."""
PATCH = 1_000_000  # at most so many characters of changes are kept with a run
INSTALLED = ("site-packages", "dist-packages")
"""Folders of installed packages, which are identified by their versions."""
MIXED = "mixed"
"""Stands in place of a digest for a file whose code changed while the run was made."""
NOT_USERS = ("memmlp", "torch", "numpy", *sys.stdlib_module_names)
"""Modules that are not the user's, wherever they lie."""


def environment() -> dict[str, Any]:
    """Describe the code, packages and hardware; the machine's name appears only as a digest."""
    packages = ("torch", "numpy", "onnxruntime")
    return {
        "version": memmlp.__version__,
        "git": _git(),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in packages},
        "platform": platform.platform(),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "host": host(),
    }


def host() -> str:
    """Return a digest of the machine's name, 12 hex digits."""
    return hashlib.sha256(platform.node().encode()).hexdigest()[:12]


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


@functools.cache
def _git() -> dict[str, Any] | None:
    """Return the commit of the package's checkout, and whether files are changed; None outside a checkout."""
    try:
        _in_git("ls-files", "--error-unmatch", "__init__.py")
        commit = _in_git("rev-parse", "HEAD")
        return {"commit": commit, "dirty": bool(_in_git("status", "--porcelain", "--", "."))}
    except (OSError, subprocess.SubprocessError):
        return None


def _in_git(*args: str) -> str:
    command = ["git", "-C", str(PACKAGE), *args]
    return subprocess.run(command, capture_output=True, text=True, timeout=20, check=True).stdout.strip()


@functools.cache
def changes() -> str:
    """Return a patch from the package's commit to the code of this process, with the names of new files.

    It is empty if nothing was changed, or if the package is not in a checkout. As commit and digests do, it
    stays as it was when this process first asked: what is edited later is not what the process runs.
    """
    git = _git()
    if not git or not git["dirty"]:
        return ""
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        new = _in_git("ls-files", "--others", "--exclude-standard", "--", ".")
        listed = "".join(f"# not in the commit: {name}\n" for name in new.splitlines())
        return (listed + _in_git("diff", "HEAD", "--", ".") + "\n")[:PATCH]
    return ""


def code_digests(packages: Iterable[str] = ()) -> dict[str, str]:
    """Return a digest of the code in each file on which a run's numbers depend.

    Comments and docstrings don't matter. Files of users' packages, and of what these import, are named
    PACKAGE:FILE.
    """
    return {name: code_digest(content) for name, content in code_files(packages).items()}


def code_files(packages: Iterable[str] = ()) -> dict[str, bytes]:
    """Return the content of each file of which `code_digests` has a digest, as this process runs it."""
    users = _user_files(packages).items()
    return _package_code() | {f"{name}:{file}": code for name, files in users for file, code in files.items()}


def describe_sources(packages: Iterable[str] = ()) -> dict[str, dict[str, str]]:
    """Return what a run's manifest has on its code: digests of each file's code and of its bytes."""
    files = code_files(packages)
    return {
        "sources": {name: code_digest(content) for name, content in files.items()},
        "source_bytes": {name: byte_digest(content) for name, content in files.items()},
    }


def byte_digest(content: bytes) -> str:
    """Return a digest of a file's content, 12 hex digits."""
    return hashlib.sha256(content).hexdigest()[:12]


def changed_since(manifest: Mapping[str, Any]) -> list[str]:
    """Return the files whose code has changed since a run with this manifest began (see `changed`).

    A file is parsed only if its bytes differ from those of the run: parsing all takes half a second.
    """
    before, unread = manifest.get("sources", {}), manifest.get("source_bytes", {})
    files = code_files(manifest.get("plugins", ())) if before else {}
    return sorted(
        name
        for name, content in files.items()
        if name in before
        and (before[name] == MIXED or unread.get(name) != byte_digest(content))
        and before[name] != code_digest(content)
    )


def changed(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """Return the files whose code differs between two records (`code_digests`).

    A file that is in only one of them is not compared: new code runs only if other code, or the config, names
    it.
    """
    return sorted(name for name in before.keys() & after.keys() if before[name] != after[name])


@functools.cache
def _package_code() -> dict[str, bytes]:
    files = {path.relative_to(PACKAGE): path for path in sorted(PACKAGE.rglob("*.py"))}
    return {name.as_posix(): path.read_bytes() for name, path in files.items() if _counts(name)}


def _counts(path: Path) -> bool:
    """Return whether a run's numbers depend on the file at this path below the package."""
    unused = path.parts[0].startswith("_") or any(map(path.is_relative_to, NOT_NUMBERS))
    return path.as_posix() in WIRING or not unused


@functools.cache
def code_digest(code: bytes) -> str:
    """Return a digest of Python code, 12 hex digits, that ignores layout, comments and docstrings.

    It is a digest of the bytes if they are not Python of this version.
    """
    try:
        tree = ast.parse(code.decode())
    except (SyntaxError, ValueError):
        return byte_digest(code)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
            node.body = node.body[1:] or [ast.Pass()]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:12]


def user_code_digests(packages: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return digests of the Python files of users' packages, by package and file; nothing is imported.

    Other modules of the user that these import follow, each by itself: of a package only its __init__, as
    PACKAGE.__init__. A package that is not found does not have files.
    """
    return {
        name: {file: code_digest(code) for file, code in files.items()}
        for name, files in _user_files(packages).items()
    }


def _user_files(packages: Iterable[str]) -> dict[str, dict[str, bytes]]:
    """Return the content of the files that `user_code_digests` describes."""
    files = {name: _package_files(name) for name in packages}
    modules = {_module(name, file): path for name, paths in files.items() for file, path in paths.items()}
    for name, path in _imported_modules(modules).items():
        files[f"{name}.__init__" if path.stem == "__init__" else name] = {path.name: path}
    return {name: {file: _user_code(path) for file, path in paths.items()} for name, paths in files.items()}


def user_packages(names: Iterable[str]) -> dict[str, dict[str, str | None]]:
    """Return the version and a digest of the code of users' packages and of what they import, by name."""
    return {
        name: {
            "version": _user_version(name),
            "digest": hashlib.sha256(repr(files).encode()).hexdigest()[:12],
        }
        for name, files in user_code_digests(names).items()
    }


def _user_version(name: str) -> str | None:
    """Return a package's own version, or that of the distribution that contains it."""
    spec = _find_spec(name)
    text = Path(spec.origin).read_text(encoding="utf-8") if spec and spec.origin else ""
    if version := re.search(r'^__version__ = "(.+)"$', text, re.MULTILINE):
        return version[1]
    distributions = _distributions().get(name.split(".")[0], [])
    return _version(distributions[0]) if distributions else None


@functools.cache
def _distributions() -> Mapping[str, list[str]]:
    return metadata.packages_distributions()


@functools.cache
def _user_code(path: Path) -> bytes:
    """Return a file's content when this process first asked: later edits are not what the process runs."""
    return path.read_bytes()


def _package_files(name: str) -> dict[str, Path]:
    """Return the Python files of a user's package by their paths below it; none if it is not found."""
    spec = _find_spec(name)
    if spec is None:
        return {}
    if folders := [Path(folder) for folder in spec.submodule_search_locations or ()]:
        files = {path.relative_to(root).as_posix(): path for root in folders for path in root.rglob("*.py")}
    else:
        files = {Path(path).name: Path(path) for path in [spec.origin] if path}
    return dict(sorted(files.items()))


def _module(package: str, file: str) -> str:
    """Return the dotted name of the module in a package's file; of a package of one file, that is its own."""
    spec = _find_spec(package)
    if spec is None or spec.submodule_search_locations is None:
        return package
    parts = Path(file).with_suffix("").parts
    return ".".join([package, *(parts[:-1] if parts[-1] == "__init__" else parts)])


def _imported_modules(modules: Mapping[str, Path]) -> dict[str, Path]:
    """Return the files of further modules of the user that some modules import, directly or not.

    Modules of memmlp, of the standard library and of installed packages are left out, and so is what is
    imported by calls (`importlib.import_module`).

    Args:
        modules: the files to begin with, by the dotted names of the modules.
    """
    found: dict[str, Path] = {}
    remaining = dict(modules)
    while remaining:
        for module in _imports(*remaining.popitem()):
            if module not in found and module not in modules and (file := _user_file(module)):
                found[module] = remaining[module] = file
    return dict(sorted(found.items()))


def _imports(module: str, file: Path) -> Iterator[str]:
    """Yield dotted names that a module may import, with their parents; some may not be modules."""
    names = [module]
    package = module.split(".") if file.name == "__init__.py" else module.split(".")[:-1]
    with contextlib.suppress(SyntaxError, ValueError):  # not Python of this version, as an extension module
        for node in ast.walk(ast.parse(file.read_bytes())):
            if isinstance(node, ast.Import):
                names += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                above = package[: len(package) - node.level + 1] if node.level else []
                source = [*above, *([node.module] if node.module else [])]
                names += [".".join([*source, alias.name]) for alias in node.names]
    for name in names:
        parts = name.split(".")
        yield from (".".join(parts[:count]) for count in range(1, len(parts) + (name != module)))


def _user_file(module: str) -> Path | None:
    """Return the file of a user's module; None if it does not exist, or is not the user's."""
    spec = _find_spec(module)
    if spec is None or not spec.has_location or not spec.origin:  # such as a folder without __init__.py
        return None
    file = Path(spec.origin)
    return file if file.is_file() and not set(INSTALLED) & set(file.parts) else None


def _find_spec(module: str) -> ModuleSpec | None:
    """Return where a module lies, without importing it or its parents; None if it is not the user's."""
    top, *submodules = module.split(".")
    try:
        spec = None if top in NOT_USERS else importlib.util.find_spec(top)
    except ValueError:  # a module that was made by hand
        return None
    for part in submodules:
        if spec is None or spec.submodule_search_locations is None:
            return None
        # By its last name only: with the whole name, a folder without __init__.py needs its parent imported.
        spec = PathFinder.find_spec(part, list(spec.submodule_search_locations))
    return spec


def _cpu() -> str:
    with contextlib.suppress(OSError):
        match = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        if match:
            return match[1].strip()
    return platform.processor() or platform.machine()
