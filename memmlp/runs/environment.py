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
from collections.abc import Iterable, Mapping
from importlib import metadata
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

import memmlp

PACKAGE = Path(memmlp.__file__).parent
NOT_NUMBERS = ("cli", "config", "live", "report", "runs/loggers", "sweep")
"""Folders with code that does not affect results; only `live` measures one, the time of a pose."""
WIRING = ("config/build.py", "config/build_request.py")
"""Files of these folders that count nevertheless, since they decide what reaches the constructors."""
PATCH = 1_000_000  # at most so many characters of changes are kept with a run
MIXED = "mixed"
"""The value in place of a digest for a file that changed while the run was made."""
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

    Comments and docstrings don't matter. Files of users' packages are named PACKAGE:FILE.
    """
    return {name: code_digest(content) for name, content in code_files(packages).items()}


def code_files(packages: Iterable[str] = ()) -> dict[str, bytes]:
    """Return the content of each file of `code_digests`, as this process runs it."""
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
    """Return the files with other code than when a run with this manifest began (see `changed`).

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
    """Return the files with different code in two records (`code_digests`).

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


def _user_files(packages: Iterable[str]) -> dict[str, dict[str, bytes]]:
    """Return the content of the Python files of users' packages, by package and file; nothing is imported.

    A package that is not found does not have files.
    """
    return {
        name: {file: _user_code(path) for file, path in _package_files(name).items()} for name in packages
    }


def user_packages(names: Iterable[str]) -> dict[str, dict[str, str | None]]:
    """Return the version and a digest of the code of users' packages, by name."""
    digests = {
        name: {file: code_digest(code) for file, code in files.items()}
        for name, files in _user_files(names).items()
    }
    return {
        name: {"version": _user_version(name), "digest": byte_digest(repr(files).encode())}
        for name, files in digests.items()
    }


def _user_version(name: str) -> str | None:
    """Return a package's own version, or that of the distribution that contains it."""
    spec = _find_spec(name)
    text = Path(spec.origin).read_text(encoding="utf-8") if spec and spec.origin else ""
    if version := re.search(r'^__version__ = "(.+)"$', text, re.MULTILINE):
        return version[1]
    distributions = metadata.packages_distributions().get(name.split(".")[0], [])
    return _version(distributions[0]) if distributions else None


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


def _find_spec(name: str) -> ModuleSpec | None:
    """Return where a user's package lies, without importing it or its parents; None if it is not found."""
    top, *submodules = name.split(".")
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


MACHINE = ("device", "gpu", "gpu_index", "threads", "processes", "precision", "cpu")
"""What can change a result's last digits, and which of a machine's GPUs it was."""

PREREQUISITES = "prerequisite_runs"
"""The key of the manifest with the origins of a run's prerequisite runs."""

FACTS = ("component_versions", "git", "version", "sources", "plugins", "packages", *MACHINE)
"""What the manifest of a prerequisite run has on its code and its machine."""


def prerequisite_origins(manifest: Mapping[str, Any], weights: str | None) -> list[dict[str, Any]]:
    """Return the origins of the prerequisite runs of a run that begins, the nearest first.

    Each has the run's `id` and `kind`, the SHA-256 of its `weights`, and the known FACTS.

    Args:
        manifest: the manifest of the finished run whose weights the run uses.
        weights: the SHA-256 of these weights.
    """
    own = {"id": manifest.get("id"), "kind": manifest.get("kind"), "weights": weights}
    facts = {name: manifest[name] for name in FACTS if name in manifest}
    return [own | facts, *recorded_prerequisites(manifest)]


def recorded_prerequisites(manifest: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the origins of the prerequisite runs in a run's manifest."""
    return manifest.get(PREREQUISITES) or []


def prerequisite_versions(manifest: Mapping[str, Any]) -> dict[str, int]:
    """Return the component versions with which a run's prerequisite runs were trained, from its manifest."""
    every = [one.get("component_versions") or {} for one in recorded_prerequisites(manifest)]
    return {name: number for versions in every for name, number in versions.items()}


def join_origins(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """Join the origins of a training before and after it was resumed; if they differ, both are kept.

    A file with code that changed in between gets "mixed" in place of a digest. Prerequisite runs that changed
    since (trained again, under the same ids) follow the present ones.

    Args:
        before: the manifest so far, empty for a training from the start.
        after: the origin of the resumed training.
    """
    found = dict(after)
    for key in MACHINE:
        words = [before[key]] if key in before and before[key] != after.get(key) else []
        found[key] = ", ".join(map(str, [*words, after[key]])) if words else after.get(key)
    old, new = before.get("git"), after.get("git")
    if old and new:
        other = old.get("before") or (old["commit"] if old["commit"] != new["commit"] else None)
        found["git"] = {**new, "dirty": old["dirty"] or new["dirty"]} | ({"before": other} if other else {})
    known = before.get("sources", after["sources"])
    found["sources"] = after["sources"] | dict.fromkeys(changed(known, after["sources"]), MIXED)
    prerequisite = after.get(PREREQUISITES, [])
    if earlier := [one for one in before.get(PREREQUISITES, []) if one not in prerequisite]:
        found[PREREQUISITES] = [*prerequisite, *earlier]
    for name, package in (before.get("plugins") or {}).items():
        now = (after.get("plugins") or {}).get(name, package)
        if now["digest"] != package["digest"]:
            found["plugins"] = {**found["plugins"], name: {**now, "digest": MIXED}}
    return found
