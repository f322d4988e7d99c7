"""The environment of a run: code version, packages and hardware."""

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
"""Folders with code that does not affect results (only `live` measures a result: the time of a pose)."""
WIRING = ("config/build.py", "config/build_request.py")
"""Exceptions in these folders: files that affect results, since they call the constructors."""
PATCH = 1_000_000  # maximum length of the code patch in a run's folder, characters
MIXED = "mixed"
"""Replaces the digest of a file that changed between two attempts of a run."""
NOT_USERS = ("memmlp", "torch", "numpy", *sys.stdlib_module_names)
"""Modules that never belong to the user, whatever their path."""


def describe_environment() -> dict[str, Any]:
    """Describe the code, packages and hardware; the machine's name appears only as a digest."""
    packages = ("torch", "numpy", "onnxruntime")
    return {
        "version": memmlp.__version__,
        "git": _describe_commit(),
        "python": platform.python_version(),
        "packages": {name: _find_installed_version(name) for name in packages},
        "platform": platform.platform(),
        "cpu": _describe_cpu(),
        "cores": os.cpu_count(),
        "host": hash_host_name(),
    }


def hash_host_name() -> str:
    """Return a digest of the machine's name, 12 hex digits."""
    return hashlib.sha256(platform.node().encode()).hexdigest()[:12]


def _find_installed_version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


@functools.cache
def _describe_commit() -> dict[str, Any] | None:
    """Return the commit of the package and whether its files were modified; None outside a git checkout."""
    try:
        _run_git("ls-files", "--error-unmatch", "__init__.py")
        commit = _run_git("rev-parse", "HEAD")
        return {"commit": commit, "dirty": bool(_run_git("status", "--porcelain", "--", "."))}
    except (OSError, subprocess.SubprocessError):
        return None


def _run_git(*args: str) -> str:
    command = ["git", "-C", str(PACKAGE), *args]
    return subprocess.run(command, capture_output=True, text=True, timeout=20, check=True).stdout.strip()


@functools.cache
def create_code_patch() -> str:
    """Return a patch from the package's commit to the code of this process, and the names of untracked files;
    empty without modifications or outside a git checkout. Later edits are ignored, since they do not run."""
    git = _describe_commit()
    if not git or not git["dirty"]:
        return ""
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        new = _run_git("ls-files", "--others", "--exclude-standard", "--", ".")
        header = "".join(f"# not in the commit: {name}\n" for name in new.splitlines())
        return (header + _run_git("diff", "HEAD", "--", ".") + "\n")[:PATCH]
    return ""


def compute_code_digests(packages: Iterable[str] = ()) -> dict[str, str]:
    """Return the code digest of each file that affects a run's numbers; PACKAGE:FILE for users' packages."""
    return {name: compute_code_digest(content) for name, content in read_code_files(packages).items()}


def read_code_files(packages: Iterable[str] = ()) -> dict[str, bytes]:
    """Return the content of each file that affects the numbers of a run, as this process runs it."""
    users = {f"{name}:{file}": code for name in packages for file, code in _read_user_files(name).items()}
    return _read_package_code() | users


def describe_sources(packages: Iterable[str] = ()) -> dict[str, dict[str, str]]:
    """Return the manifest entries about the code: digests of each file's code and of its bytes."""
    files = read_code_files(packages)
    return {
        "sources": {name: compute_code_digest(content) for name, content in files.items()},
        "source_bytes": {name: compute_byte_digest(content) for name, content in files.items()},
    }


def compute_byte_digest(content: bytes) -> str:
    """Return a digest of a file's content, 12 hex digits."""
    return hashlib.sha256(content).hexdigest()[:12]


def list_changed_files(manifest: Mapping[str, Any]) -> list[str]:
    """Return the files that have changed since a run with this manifest began (`list_differing_files`). Only
    files with different bytes are parsed, since parsing all files takes half a second."""
    before, unread = manifest.get("sources", {}), manifest.get("source_bytes", {})
    files = read_code_files(manifest.get("plugins", ())) if before else {}
    return sorted(
        name
        for name, content in files.items()
        if name in before
        and (before[name] == MIXED or unread.get(name) != compute_byte_digest(content))
        and before[name] != compute_code_digest(content)
    )


def list_differing_files(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """Return the files with different digests in two results of `compute_code_digests`. Files in only one of
    them are ignored: new code runs only if other code or the config changed, too."""
    return sorted(name for name in before.keys() & after.keys() if before[name] != after[name])


@functools.cache
def _read_package_code() -> dict[str, bytes]:
    names = [path.relative_to(PACKAGE) for path in sorted(PACKAGE.rglob("*.py"))]
    unused = [one for one in names if one.parts[0][0] == "_" or any(map(one.is_relative_to, NOT_NUMBERS))]
    counting = [one for one in names if one not in unused or one.as_posix() in WIRING]
    return {name.as_posix(): (PACKAGE / name).read_bytes() for name in counting}


@functools.cache
def compute_code_digest(code: bytes) -> str:
    """Return a digest (12 hex digits) of Python code, or of bytes, without layout, comments and
    docstrings."""
    try:
        tree = ast.parse(code.decode())
    except (SyntaxError, ValueError):
        return compute_byte_digest(code)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
            node.body = node.body[1:] or [ast.Pass()]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:12]


def _read_user_files(package: str) -> dict[str, bytes]:
    """Return the content of all Python files in a user's package, by file; empty if it is not found."""
    return {file: _read_user_code(path) for file, path in _list_package_files(package).items()}


def describe_user_packages(names: Iterable[str]) -> dict[str, dict[str, str | None]]:
    """Return the version and code digest of each user's package, by name."""
    found: dict[str, dict[str, str | None]] = {}
    for name in names:
        digests = {file: compute_code_digest(code) for file, code in _read_user_files(name).items()}
        digest = compute_byte_digest(repr(digests).encode())
        found[name] = {"version": _find_user_version(name), "digest": digest}
    return found


def _find_user_version(name: str) -> str | None:
    """Return a user package's `__version__`, otherwise the version of the distribution with the package."""
    spec = _find_spec(name)
    text = Path(spec.origin).read_text(encoding="utf-8") if spec and spec.origin else ""
    if version := re.search(r'^__version__ = "(.+)"$', text, re.MULTILINE):
        return version[1]
    distributions = metadata.packages_distributions().get(name.split(".")[0], [])
    return _find_installed_version(distributions[0]) if distributions else None


@functools.cache
def _read_user_code(path: Path) -> bytes:
    """Read a file once for each process, since the process does not run later edits."""
    return path.read_bytes()


def _list_package_files(name: str) -> dict[str, Path]:
    spec = _find_spec(name)
    if spec is None:
        return {}
    if folders := [Path(folder) for folder in spec.submodule_search_locations or ()]:
        files = {path.relative_to(root).as_posix(): path for root in folders for path in root.rglob("*.py")}
    else:
        files = {Path(path).name: Path(path) for path in [spec.origin] if path}
    return dict(sorted(files.items()))


def _find_spec(name: str) -> ModuleSpec | None:
    """Find a user's package without importing it or its parents; None if it is not found."""
    top, *submodules = name.split(".")
    try:
        spec = None if top in NOT_USERS else importlib.util.find_spec(top)
    except ValueError:  # a module without a spec, created by code
        return None
    for part in submodules:
        if spec is None or spec.submodule_search_locations is None:
            return None
        # Search by the last name: with the whole name, a namespace package would need its parent imported.
        spec = PathFinder.find_spec(part, list(spec.submodule_search_locations))
    return spec


def _describe_cpu() -> str:
    with contextlib.suppress(OSError):
        match = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        if match:
            return match[1].strip()
    return platform.processor() or platform.machine()


MACHINE = ("device", "gpu", "gpu_index", "threads", "processes", "precision", "cpu")
"""Manifest keys of hardware that can change the last digits of a result."""

PREREQUISITES = "prerequisite_runs"
"""The manifest key with the origins of a run's prerequisite runs."""

FACTS = ("component_versions", "git", "version", "sources", "plugins", "packages", *MACHINE)
"""Manifest keys about a run's code and machine, copied from prerequisite runs."""


def list_prerequisite_origins(manifest: Mapping[str, Any], weights: str | None) -> list[dict[str, Any]]:
    """Return the origins of all prerequisite runs for a new run, the direct one first: `id`, `kind`, SHA-256
    of its `weights`, and the known FACTS of its manifest."""
    origin = {"id": manifest.get("id"), "kind": manifest.get("kind"), "weights": weights}
    facts = {name: manifest[name] for name in FACTS if name in manifest}
    return [origin | facts, *get_recorded_prerequisites(manifest)]


def get_recorded_prerequisites(manifest: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the origins of the prerequisite runs in a run's manifest."""
    return manifest.get(PREREQUISITES) or []


def collect_prerequisite_versions(manifest: Mapping[str, Any]) -> dict[str, int]:
    """Return the component versions of the prerequisite runs in a run's manifest, by component."""
    every = [one.get("component_versions") or {} for one in get_recorded_prerequisites(manifest)]
    return {name: number for versions in every for name, number in versions.items()}


def merge_run_origins(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """Merge the facts about code and machine before (empty from scratch) and after a training was resumed.
    Different values are both kept. The digest of a changed file is replaced by "mixed". Current prerequisite
    runs come first, then earlier versions of prerequisite runs that were trained again."""
    merged = dict(after)
    for key in MACHINE:
        now = after.get(key)
        merged[key] = f"{before[key]}, {now}" if key in before and before[key] != now else now
    old, new = before.get("git"), after.get("git")
    if old and new:
        other = old.get("before") or (old["commit"] if old["commit"] != new["commit"] else None)
        merged["git"] = {**new, "dirty": old["dirty"] or new["dirty"]} | ({"before": other} if other else {})
    sources = before.get("sources", after["sources"])
    mixed = list_differing_files(sources, after["sources"])
    merged["sources"] = after["sources"] | dict.fromkeys(mixed, MIXED)
    prerequisite = after.get(PREREQUISITES, [])
    if earlier := [one for one in before.get(PREREQUISITES, []) if one not in prerequisite]:
        merged[PREREQUISITES] = [*prerequisite, *earlier]
    for name, package in (before.get("plugins") or {}).items():
        now = (after.get("plugins") or {}).get(name, package)
        if now["digest"] != package["digest"]:
            merged["plugins"] = {**merged["plugins"], name: {**now, "digest": MIXED}}
    return merged
