"""The environment of a run: code version, packages and hardware."""

from __future__ import annotations

import ast
import contextlib
import functools
import hashlib
import os
import platform
import re
import subprocess
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import memmlp
from memmlp.runs.user_modules import imported_modules, imports_by_computed_names, module_spec

PACKAGE = Path(memmlp.__file__).parent
NOT_NUMBERS = (
    "cli",
    "config",
    "live",
    "report",
    "runs/loggers",
    "sweep",
    "tables",
)
"""Folders of the package on whose code no result depends; `live` alone measures one, whole poses' times."""
WIRING = ("config/build.py", "config/build_motion.py")
"""Files of these folders that count all the same, since they decide what reaches the constructors."""
PATCH = 1_000_000  # at most so many characters of changes are kept with a run


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
    """Run git in the package's folder and return its output."""
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

    Comments and docstrings don't matter. Files of the user's own packages, and of what these import, are
    named PACKAGE:FILE.
    """
    own = own_code_digests(packages).items()
    return _code_digests() | {
        f"{name}:{file}": digest for name, files in own for file, digest in files.items()
    }


def changed(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """Return the files whose code differs between two records (`code_digests`).

    A file that is in one of them alone is not compared: what is new runs only if other code, or the config,
    names it, and records of earlier versions lack what packages import.
    """
    return sorted(name for name in before.keys() & after.keys() if before[name] != after[name])


@functools.cache
def _code_digests() -> dict[str, str]:
    """Return the digests of this package's files."""
    files = [path for path in sorted(PACKAGE.rglob("*.py")) if _counts(path.relative_to(PACKAGE))]
    return {path.relative_to(PACKAGE).as_posix(): code_digest(path.read_text("utf-8")) for path in files}


def own_code_digests(packages: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return digests of the Python files of users' packages, by package and file; nothing is imported.

    Modules of the user's own that these import (`imported_modules`) follow, each by itself: of a package only
    its __init__, as PACKAGE.__init__. A package that is not found has no files.
    """
    return {
        name: {file: _own_digest(path) for file, path in own.items()}
        for name, own in _own_files(packages).items()
    }


def _own_files(packages: Iterable[str]) -> dict[str, dict[str, Path]]:
    """Return the files of `own_code_digests`, by package and file."""
    files = {name: _package_files(name) for name in packages}
    modules = {_module(name, file): path for name, own in files.items() for file, path in own.items()}
    imported = {
        f"{name}.__init__" if path.stem == "__init__" else name: {path.name: path}
        for name, path in imported_modules(modules).items()
    }
    return {**files, **imported}


def _package_files(name: str) -> dict[str, Path]:
    """Return the Python files of a user's package by their paths below it; none if it is not found."""
    spec = module_spec(name)
    if spec is None:
        return {}
    if folders := [Path(folder) for folder in spec.submodule_search_locations or ()]:
        files = {path.relative_to(root).as_posix(): path for root in folders for path in root.rglob("*.py")}
    else:
        files = {Path(path).name: Path(path) for path in [spec.origin] if path}
    return dict(sorted(files.items()))


def _module(package: str, file: str) -> str:
    """Return the dotted name of the module in a package's file; of a package of one file, that is its own."""
    spec = module_spec(package)
    if spec is None or spec.submodule_search_locations is None:
        return package
    parts = Path(file).with_suffix("").parts
    return ".".join([package, *(parts[:-1] if parts[-1] == "__init__" else parts)])


@functools.cache
def _own_digest(path: Path) -> str:
    """Return a digest of a file's code, or of its bytes if it is not Python of this version.

    It stays as it was when this process first asked: what is edited later is not what the process runs.
    """
    try:
        return code_digest(path.read_text("utf-8"))
    except (SyntaxError, ValueError):
        return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


def packages_of_ones_own(names: Iterable[str]) -> dict[str, dict[str, str | None]]:
    """Return the version and a digest of the code of some packages and of what they import, by name.

    One with files that import by computed names has these, with commas between, as `computed_imports`: edits
    of what they import are not seen.
    """
    packages = list(names)

    def digest(files: Mapping[str, str]) -> str:
        return hashlib.sha256(repr(files).encode()).hexdigest()[:12]

    def computed(name: str, files: Mapping[str, Path]) -> dict[str, str | None]:
        modules = {file: _module(name.removesuffix(".__init__"), file) for file in files}
        found = [f for f, path in files.items() if imports_by_computed_names(modules[f], path, packages)]
        return {"computed_imports": ", ".join(found)} if found else {}

    own, digests = _own_files(packages), own_code_digests(packages)
    return {
        name: {"version": _own_version(name), "digest": digest(digests[name]), **computed(name, files)}
        for name, files in own.items()
    }


def computed_imports(plugins: Mapping[str, Mapping[str, str | None]]) -> str | None:
    """Return which files of the recorded packages import by computed names, in words; None for none."""
    found = {name: one.get("computed_imports") for name, one in plugins.items()}
    return "; ".join(f"{name}: {files}" for name, files in found.items() if files) or None


def _own_version(name: str) -> str | None:
    """Return a package's own version, or that of the distribution that contains it."""
    spec = module_spec(name)
    text = Path(spec.origin).read_text(encoding="utf-8") if spec and spec.origin else ""
    if version := re.search(r'^__version__ = "(.+)"$', text, re.MULTILINE):
        return version[1]
    distributions = _distributions().get(name.split(".")[0], [])
    return _version(distributions[0]) if distributions else None


@functools.cache
def _distributions() -> Mapping[str, list[str]]:
    """Return the installed distributions by the top-level packages that they contain."""
    return metadata.packages_distributions()


def _counts(path: Path) -> bool:
    """Return whether a run's numbers depend on the file at this path below the package."""
    unused = path.parts[0].startswith("_") or any(map(path.is_relative_to, NOT_NUMBERS))
    return path.as_posix() in WIRING or not unused


def code_digest(text: str) -> str:
    """Return a digest of Python code, 12 hex digits, that ignores layout, comments and docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
            node.body = node.body[1:] or [ast.Pass()]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:12]


def _cpu() -> str:
    """Return the processor's model name."""
    with contextlib.suppress(OSError):
        match = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        if match:
            return match[1].strip()
    return platform.processor() or platform.machine()
