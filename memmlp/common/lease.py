"""Leases: a folder belongs to one process at a time, whether or not the file system supports locks.

A process that wants the folder makes the file with the next number, `.lease-N`, which only one process can
make. The highest number is the owner's; the owner touches its file every few seconds. A folder is released by
a claim for nobody with the next number, so that numbers only grow. The next claim may be made by

- any process, if the last claim is nobody's or belongs to a dead process on this machine;
- a process that has seen the last claim unchanged for longer than LEASE, by its own clock.

The kernel's lock (`.lock`) is taken as well, if possible. While another process has it, a claim ends only
when its lease has expired. A free lock proves nothing, since some file systems have no locks.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from memmlp.common.errors import LeaseLost
from memmlp.common.files import now
from memmlp.common.lease_claims import Claim, Claims
from memmlp.common.lease_fences import fenced, remove_unfinished
from memmlp.common.liveness import Changes, myself, place

LEASE = 60.0  # seconds without a sign of life, as another process sees it, after which a claim is over
BEAT = 5.0  # seconds between an owner's signs of life
PAUSE = 0.2  # seconds between looks at a folder that is waited for
NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP}
"""Errors of file systems that know no locks."""

_changes = Changes()
_held: dict[tuple[int, int, str], Lease] = {}


class Lease:
    """This process' claim on a folder.

    Attributes:
        number: the claim's number, higher than those of all owners before.
    """

    def __init__(self, claims: Claims, number: int, what: str):
        self.claims, self.number, self.what = claims, number, what
        self.lost = False

    def check(self) -> None:
        """Raise LeaseLost if another process has made a later claim."""
        if not self.lost:
            self._look()
        if self.lost:
            raise LeaseLost(
                f"{self.what}: another process took it over, for this one stood still for longer than "
                f"{LEASE:.0f} s; it writes nothing more there"
            )

    def _look(self) -> None:
        """Touch the claim, which reaches the server of a shared folder, and look for later claims."""
        try:
            os.utime(self.claims.path(self.number))
        except OSError as error:
            if error.errno not in (errno.ENOENT, errno.ESTALE):
                raise
            self.lost = True
        self.lost = self.lost or self.claims.numbers()[-1:] != [self.number]

    @contextlib.contextmanager
    def kept(self) -> Iterator[None]:
        """Show signs of life during the context, then release the folder."""
        ended = threading.Event()
        thread = threading.Thread(target=self._beat, args=(ended,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
            self._release()

    def _beat(self, ended: threading.Event) -> None:
        """Keep the claim alive until it is lost or `ended` is set."""
        while not (self.lost or ended.wait(BEAT)):
            with contextlib.suppress(OSError):
                self._look()

    def _release(self) -> None:
        """Claim the folder for nobody. If the disk refuses that, the claim expires instead."""
        with contextlib.suppress(OSError):
            if not self.lost and self.claims.make(self.number + 1):
                self.claims.path(self.number).unlink(missing_ok=True)


class Lock:
    """The lock of a folder, by leases; a thread may hold it several times.

    Args:
        folder: the folder in which claims are made.
        name: the folder inside it that is locked; by default `folder` itself.
    """

    def __init__(self, folder: Path, name: str = ""):
        self.folder, self.name = folder, name
        dot = f".{name}" if name else ""
        self.kernel, self.claims = folder / f"{dot}.lock", Claims(folder, f"{dot}.lease-")

    @contextlib.contextmanager
    def hold(self, say: Callable[[str], None] | None = None, wait: bool = True) -> Iterator[Lease | None]:
        """Hold the lock, and yield the lease; None if another process has it.

        Within the context, everything that this process publishes below the folder is fenced: once another
        process has taken over the folder, LeaseLost is raised instead.

        Args:
            say: gets a line about the process for which this one waits; by default the line goes to stderr.
            wait: whether to wait while another process has the lock.
        """
        key = (os.getpid(), threading.get_ident(), os.path.realpath(self.kernel))
        if key in _held:
            yield _held[key]
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            lease = self._take(stack)
            if lease is None and wait:
                (say or _say)(f"{self._what} is in the hands of {self._who()}; waiting for it")
                lease = self._wait(stack)
            if lease is not None:
                stack.enter_context(lease.kept())
                stack.enter_context(fenced(self._held_folder, lease))
                stack.callback(_held.pop, key)
                _held[key] = lease
            yield lease

    @property
    def owner(self) -> dict[str, Any] | None:
        """The description of the process that holds the lock; None if none does."""
        last = self.claims.last()
        return last.owner if last else None

    @property
    def held(self) -> bool | None:
        """Whether the process that holds the lock is alive, as far as is known; None if no process holds it.

        A process on another machine counts as alive until it has shown no sign of life for LEASE.
        """
        last, idle = self._look()
        if last is None or last.free:
            return None
        return last.lives or _open(last, idle)

    def settle(self, say: Callable[[str], None] | None = None) -> None:
        """Watch the process that holds the lock until it is known whether it is alive.

        That takes up to LEASE for a process on another machine, and no time otherwise.

        Args:
            say: gets a line if it takes time; by default the line goes to stderr.
        """
        first, idle = self._look()
        last = first
        if _open(first, idle):
            (say or _say)(f"{self._what}: looking whether {self._who()} lives, for up to {LEASE:.0f} s")
        while last == first and _open(last, idle):
            time.sleep(PAUSE)
            last, idle = self._look()

    def _look(self) -> tuple[Claim | None, float]:
        """Return the last claim, and for how many seconds this process has seen it unchanged."""
        seen: list[Claim | None] = []

        def look() -> Claim | None:
            seen.append(self.claims.last())
            return seen[-1]

        idle = _changes.unchanged(self.kernel, look)
        return seen[-1], idle

    def _wait(self, stack: ExitStack) -> Lease:
        while (lease := self._take(stack)) is None:
            time.sleep(PAUSE)
        return lease

    def _take(self, stack: ExitStack) -> Lease | None:
        """Make the next claim if the last one is over, and return the lease; None if it is not.

        Actions to be undone later are pushed on the stack.
        """
        last, idle = self._look()
        over = last is None or last.free or last.lives is False
        expired = last is not None and idle > LEASE
        if not (over or expired):
            return None
        with ExitStack() as own:
            if not (self._take_kernels(own) or expired):
                return None
            lease = self._claim(last)
            if lease is not None:
                stack.enter_context(own.pop_all())
            return lease

    def _claim(self, last: Claim | None) -> Lease | None:
        """Make the claim after `last`; None if another process has made it, even long ago."""
        number = last.number + 1 if last else 1
        if not self.claims.make(number, {**myself(), "since": now()}):
            return None
        if self.claims.numbers()[-1:] != [number]:  # `last` was seen before this process was frozen
            self.claims.path(number).unlink(missing_ok=True)
            return None
        self.claims.remove_below(number)
        remove_unfinished(self._held_folder, number)
        return Lease(self.claims, number, self._what)

    def _take_kernels(self, stack: ExitStack) -> bool:
        """Take the kernel's lock, and return whether no other process has it."""
        try:
            stack.enter_context(FileLock(self.kernel, timeout=0, fallback_to_soft=False))
        except Timeout:
            return False
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
        return True

    @property
    def _held_folder(self) -> Path:
        return self.folder / self.name

    @property
    def _what(self) -> str:
        return f"{self._held_folder.parent.name.removesuffix('s')} {self._held_folder.name}"

    def _who(self) -> str:
        owner = self.owner
        if not owner:
            return "another process"
        where = "" if owner["place"] == place() else " of another machine"
        return f"process {owner['pid']}{where} since {owner['since']}"


def _open(claim: Claim | None, idle: float) -> bool:
    """Return whether it is still unknown if the owner lives, `idle` seconds after its last sign of life."""
    return claim is not None and not claim.free and claim.lives is None and idle <= LEASE


def _say(line: str) -> None:
    print(f"memmlp: {line}", file=sys.stderr, flush=True)
