"""Whether a process is alive: on this machine by its number, elsewhere by its signs of life (heartbeat).

A sign of life from another machine is never compared with this machine's clock, since clocks may differ by
hours. What counts is how long this process has seen no change in it.
"""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import time
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path
from typing import Any

PROC = Path("/proc")
DEAD = ("Z", "X")  # states of a process that is over, though its parent has not asked for its end yet


@functools.cache
def place() -> str:
    """Return a digest of machine, boot and container, within which a number identifies a process."""
    words = [platform.node(), _text(PROC / "sys/kernel/random/boot_id"), _link(PROC / "self/ns/pid")]
    return hashlib.sha256("\n".join(words).encode()).hexdigest()[:12]


def myself() -> dict[str, Any]:
    """Describe this process, so that `lives` can be asked about it wherever the same files are visible."""
    return {"pid": os.getpid(), "born": _born(os.getpid()), "place": place()}


def lives(process: Mapping[str, Any]) -> bool | None:
    """Return whether a process that described itself is alive; None if it is on another machine."""
    if process.get("place") != place():
        return None
    pid = int(process["pid"])
    return _runs(pid) and _born(pid) == process.get("born")


class Changes:
    """Measures how long values have been unchanged, by this process' clock, which never jumps."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self.clock = clock
        self.seen: dict[Hashable, tuple[object, float]] = {}

    def unchanged(self, key: Hashable, look: Callable[[], object]) -> float:
        """Look at a value, and return the seconds for which it was certainly unchanged; 0 at the first look.

        Args:
            key: the value's name.
            look: returns the value.
        """
        before = self.clock()  # if this process is frozen while it looks, the time must not count
        sight = look()
        known = self.seen.get(key)
        if known is None or known[0] != sight:
            self.seen[key] = (sight, self.clock())
            return 0.0
        return before - known[1]


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return _stat(pid)[:1] not in [[state] for state in DEAD]


def _born(pid: int) -> str | None:
    """Return when a process was started, in the kernel's ticks; the next process with its number differs."""
    fields = _stat(pid)
    return fields[19] if len(fields) > 19 else None


def _stat(pid: int) -> list[str]:
    """Return the kernel's fields of a process, from its state on; empty without /proc."""
    return _text(PROC / str(pid) / "stat").rpartition(")")[2].split()


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""


def _link(path: Path) -> str:
    try:
        return os.readlink(path)
    except OSError:
        return ""
