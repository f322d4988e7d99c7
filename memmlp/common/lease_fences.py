"""Fences: a process that holds a folder by a lease can write below it only while it owns the lease.

A lease has a number (a fencing token), and the next owner's is higher (memmlp.common.lease). A file is made
under a temporary name that contains the number; the fence is checked, and the file renamed. The next owner
removes temporary files of lower numbers before it begins. So a process that wakes up after it was
superseded, even between check and rename, finds that its file is gone, and publishes nothing.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

FENCED = re.compile(r"^\..*\.lease-(\d+)\.[0-9a-f]+\.tmp$")


class Fence(Protocol):
    """Checks, before a process publishes in a folder, that the folder is still its own."""

    number: int

    def check(self) -> None:
        """Raise LeaseLost if the folder has another owner now."""


_FENCES: dict[Path, Fence] = {}


@contextlib.contextmanager
def fenced(folder: Path, fence: Fence) -> Iterator[None]:
    """Within this context, let this process write below the folder only while the fence's check passes."""
    key = _real(folder)
    _FENCES[key] = fence
    try:
        yield
    finally:
        del _FENCES[key]


def fence_of(path: Path) -> Fence | None:
    """Return the fence of the folder that contains the path; None if this process holds none."""
    real = _real(path)
    return next((_FENCES[folder] for folder in (real, *real.parents) if folder in _FENCES), None)


def check_owner(path: Path) -> None:
    """Raise LeaseLost if this process held the path's folder and has lost it.

    Call this before appending to a file or removing it. A freeze of the process after the check is not
    noticed.
    """
    if fence := fence_of(path):
        fence.check()


def temporary(path: Path) -> Path:
    """Return a unique name for the unfinished form of a file, beside the file."""
    fence = fence_of(path)
    owner = f"lease-{fence.number}." if fence else ""
    return path.with_name(f".{path.name}.{owner}{uuid.uuid4().hex[:12]}.tmp")


def publish(unfinished: Path, path: Path) -> None:
    """Give a finished file or folder its final name.

    Args:
        unfinished: its present name, from `temporary`.
        path: its final name.

    Raises:
        LeaseLost: if this process held the path's folder and has lost it.
    """
    check_owner(path)
    try:
        os.replace(unfinished, path)
    except FileNotFoundError:
        check_owner(path)  # the next owner removed it
        raise


def remove_unfinished(folder: Path, number: int) -> None:
    """Remove unfinished files of owners with lower numbers, below a folder and of the folder itself."""
    for path in [*folder.rglob(".*.tmp"), *folder.parent.glob(f".{folder.name}.*.tmp")]:
        found = FENCED.match(path.name)
        if found and int(found[1]) < number:
            _remove(path)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _real(path: Path) -> Path:
    """Return the path with the links in its folder resolved; its last part stays as it is."""
    return Path(os.path.realpath(path.parent)) / path.name
