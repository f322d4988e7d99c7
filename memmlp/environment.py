"""What a run ran on and with."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import platform
import re
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

import memmlp


def environment() -> dict[str, Any]:
    """What a run ran on and with; the machine's name only as a digest."""
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
    """The machine, by a digest of its name."""
    return hashlib.sha256(platform.node().encode()).hexdigest()[:12]


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


@functools.cache
def _git() -> dict[str, Any] | None:
    """Commit of the checkout that the package lies in and whether it was changed; None when installed."""

    def git(*args: str) -> str:
        command = ["git", "-C", str(Path(memmlp.__file__).parent), *args]
        return subprocess.run(command, capture_output=True, text=True, timeout=20, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")
        commit = git("rev-parse", "HEAD")
        return {"commit": commit, "dirty": bool(git("status", "--porcelain", "--", "."))}
    except (OSError, subprocess.SubprocessError):
        return None


def _cpu() -> str:
    """The processor's model name."""
    with contextlib.suppress(OSError):
        match = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        if match:
            return match[1].strip()
    return platform.processor() or platform.machine()
