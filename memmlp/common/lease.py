"""Leases: a folder belongs to one process at a time, also on file systems without locks.

To take a folder, a process makes the file `.lease-N` with the next number. Only one process can make it, and
the highest number is the owner's, who touches its file every few seconds (heartbeat). To release the folder,
the owner renames its file to `.lease-N-free` with the next number, so that numbers only grow. The next claim
may be made

- by any process, if the last claim is free or belongs to a dead process on this machine;
- by a process that has seen the last claim unchanged for LEASE, by its own clock. Clocks of different
  machines are never compared, since they may differ by hours.

A process that stands still for longer than LEASE loses its folder, even if it wakes up later. Therefore it
checks its lease before it publishes anything there (`publish`, `check_owner`). The next owner first removes
the unfinished files of earlier owners, so even a process frozen between check and rename publishes nothing.

Locks of the kernel are not used: on network file systems they may be missing, or granted twice.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import json
import os
import platform
import re
import shutil
import sys
import threading
import time
import uuid
from collections.abc import Callable, Hashable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from memmlp.common.errors import LeaseLost

LEASE = 60.0  # seconds without a heartbeat, as another process sees it, after which a claim is over
BEAT = 5.0  # seconds between two heartbeats
PAUSE = 0.2  # seconds between two looks at a folder for which a process waits

PROC = Path("/proc")
ENDED = ("Z", "X")  # states of a process that has ended, though its parent has not collected it yet


@functools.cache
def process_space() -> str:
    """Return a digest of machine, boot and container, within which a number identifies a process."""
    try:
        namespace = os.readlink(PROC / "self/ns/pid")
    except OSError:
        namespace = ""
    words = [platform.node(), _text(PROC / "sys/kernel/random/boot_id"), namespace]
    return hashlib.sha256("\n".join(words).encode()).hexdigest()[:12]


def current_process() -> dict[str, Any]:
    """Describe this process, so that any process that can read the description can ask `is_alive`."""
    return {"pid": os.getpid(), "born": _birth(os.getpid()), "place": process_space()}


def is_alive(process: Mapping[str, Any]) -> bool | None:
    """Return whether a process (`current_process`) is alive; None if it is on another machine."""
    if process.get("place") != process_space():
        return None
    pid = int(process["pid"])
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # it is another user's
        pass
    return _stat(pid)[:1] not in [[state] for state in ENDED] and _birth(pid) == process.get("born")


def _birth(pid: int) -> str | None:
    """Return when a process was started, in the kernel's ticks: a later one with the same number differs."""
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


class Changes:
    """Measures how long values have been unchanged, by this process' clock, which never jumps."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self.clock = clock
        self.seen: dict[Hashable, tuple[object, float]] = {}

    def seconds_unchanged(self, key: Hashable, look: Callable[[], object]) -> float:
        """Look at a value, and return for how long it has certainly been unchanged; 0 at the first look.

        Args:
            key: the value's name.
            look: returns the value.
        """
        before = self.clock()  # if this process is frozen while it looks, the time must not count
        value = look()
        known = self.seen.get(key)
        if known is None or known[0] != value:
            self.seen[key] = (value, self.clock())
            return 0.0
        return before - known[1]


_changes = Changes()
_leases: dict[Path, Lease] = {}
"""The leases of this process by the folders that it owns."""


class Claim(NamedTuple):
    """A claim on a folder, as it was read.

    Attributes:
        number: the claim's number.
        free: whether the owner has released the folder.
        text: the content of the claim's file.
        touched: when the file was last touched, nanoseconds of the file system's clock.
    """

    number: int
    free: bool
    text: str
    touched: int

    @property
    def owner(self) -> dict[str, Any] | None:
        """The process that holds the claim; None if it is free, or can't be read, for example yet."""
        with contextlib.suppress(ValueError):
            owner = json.loads(self.text)
            return owner if isinstance(owner, dict) and not self.free else None
        return None

    def open(self, idle: float) -> bool | None:
        """Return whether the folder may be taken, given for how many seconds the claim has been unchanged.

        None means that it may be taken after LEASE without a heartbeat.
        """
        alive = is_alive(self.owner) if self.owner else None
        if self.free or alive is False or idle > LEASE:
            return True
        return None if alive is None else False


class Lock:
    """The lock of a folder; a thread may hold it several times.

    Args:
        folder: the folder in which claims are made.
        name: the folder inside it that is locked; by default `folder` itself.
    """

    def __init__(self, folder: Path, name: str = ""):
        self.folder, self.target = folder, folder / name
        self.prefix = f".{name}.lease-" if name else ".lease-"
        self.description = f"{self.target.parent.name.removesuffix('s')} {self.target.name}"

    @contextlib.contextmanager
    def hold(self, say: Callable[[str], None] | None = None, wait: bool = True) -> Iterator[Lease | None]:
        """Hold the lock, and yield the lease; None if another process has it.

        Within the context, everything that this process publishes below the folder is checked: once another
        process has taken over the folder, LeaseLost is raised instead.

        Args:
            say: gets a line about the process for which this one waits; by default the line goes to stderr.
            wait: whether to wait while another process has the lock.
        """
        key, thread = _resolved(self.target), (os.getpid(), threading.get_ident())
        if key in _leases and _leases[key].thread == thread:
            yield _leases[key]
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        lease = self._take()
        if lease is None and wait:
            (say or _to_stderr)(f"{self.description} is in use by {self.holder}; waiting for it")
            while (lease := self._take()) is None:
                time.sleep(PAUSE)
        if lease is None:
            yield None
            return
        _leases[key] = lease
        try:
            with lease.heartbeat():
                yield lease
        finally:
            del _leases[key]

    @property
    def owner(self) -> dict[str, Any] | None:
        """The description of the process that holds the lock; None if none does, or it is not known."""
        last = self._last()
        return last.owner if last else None

    @property
    def holder(self) -> str:
        """The process that holds the lock, in words."""
        owner = self.owner
        if not owner:
            return "another process"
        where = "" if owner["place"] == process_space() else " of another machine"
        return f"process {owner['pid']}{where} since {owner['since']}"

    @property
    def held(self) -> bool | None:
        """Whether the process that holds the lock is alive, if that is known; None if no process holds it.

        A process on another machine counts as alive until it has not shown a heartbeat for LEASE.
        """
        last, idle = self._watch()
        return None if last is None or last.free else not last.open(idle)

    def _watch(self) -> tuple[Claim | None, float]:
        """Return the last claim, and for how many seconds this process has seen it unchanged."""
        seen: list[Claim | None] = []

        def look() -> Claim | None:
            seen.append(self._last())
            return seen[-1]

        idle = _changes.seconds_unchanged((self.folder.absolute(), self.prefix), look)
        return seen[-1], idle

    def _last(self) -> Claim | None:
        """Return the last claim, which is the valid one; None if there was never any."""
        while claims := self.claims():
            (number, owned), path = claims[-1]
            with (
                contextlib.suppress(FileNotFoundError),  # it has been superseded meanwhile
                open(path, encoding="utf-8") as file,  # on NFS opening asks the server
            ):
                return Claim(number, not owned, file.read(), os.fstat(file.fileno()).st_mtime_ns)
        return None

    def claims(self) -> list[tuple[tuple[int, bool], Path]]:
        """Return the claims in ascending order: their numbers, whether they are owned, and their files."""
        try:
            names = os.listdir(self.folder)
        except FileNotFoundError:
            return []
        found = (re.fullmatch(re.escape(self.prefix) + r"(\d+)(-free)?", name) for name in names)
        return sorted(((int(match[1]), not match[2]), self.folder / match[0]) for match in found if match)

    def _take(self) -> Lease | None:
        """Make the next claim if the last one is over, and return the lease; None if it is not."""
        last, idle = self._watch()
        if last and not last.open(idle):
            return None
        number = last.number + 1 if last else 1
        path = self.folder / f"{self.prefix}{number}"
        since = datetime.now(UTC).isoformat(timespec="seconds")
        try:
            handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
        except FileExistsError:
            return None
        try:
            os.write(handle, json.dumps({**current_process(), "since": since}).encode())
        except OSError:
            path.unlink(missing_ok=True)
            raise
        finally:
            os.close(handle)
        *earlier, ((highest, _), _) = self.claims() or [((0, False), path)]
        if highest != number:  # this process was frozen after it looked, and others came and went
            path.unlink(missing_ok=True)
            return None
        for _, old in earlier:  # in ascending order, so that if cut short none of them becomes the last
            old.unlink(missing_ok=True)
        _remove_unfinished(self.target, number)
        return Lease(self, number, path)


class Lease:
    """This process' claim on a folder.

    Attributes:
        number: the claim's number, higher than those of all owners before.
        path: the claim's file.
        lost: whether another process is known to have taken over the folder.
    """

    def __init__(self, lock: Lock, number: int, path: Path):
        self.lock, self.number, self.path, self.lost = lock, number, path, False
        self.thread = (os.getpid(), threading.get_ident())

    def check(self) -> None:
        """Touch the claim, and raise LeaseLost if another process has made a later one."""
        try:
            os.utime(self.path)
        except OSError as error:
            if error.errno not in (errno.ENOENT, errno.ESTALE):
                raise
            self.lost = True
        self.lost = self.lost or self.lock.claims()[-1:] != [((self.number, True), self.path)]
        if self.lost:
            raise LeaseLost(
                f"{self.lock.description}: another process took it over, because this one stood still for "
                f"longer than {LEASE:.0f} s; this one writes nothing more there"
            )

    @contextlib.contextmanager
    def heartbeat(self) -> Iterator[None]:
        """Touch the claim regularly during the context, then release the folder."""
        ended = threading.Event()

        def beat() -> None:
            while not (self.lost or ended.wait(BEAT)):
                with contextlib.suppress(OSError, LeaseLost):
                    self.check()

        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
            if not self.lost:
                with contextlib.suppress(OSError):  # if the disk refuses it, the lease expires
                    self.path.rename(self.path.with_name(f"{self.lock.prefix}{self.number + 1}-free"))


def check_owner(path: Path) -> None:
    """Raise LeaseLost if this process held the path's folder and has lost it.

    Call this before appending to a file or removing it. A freeze of the process after the check is not
    noticed.
    """
    if lease := _lease_of(path):
        lease.check()


def temporary(path: Path) -> Path:
    """Return a unique name for the unfinished form of a file or folder, beside it."""
    lease = _lease_of(path)
    owner = f".lease-{lease.number}" if lease else ""
    return path.with_name(f".{path.name}{owner}.{uuid.uuid4().hex[:12]}.tmp")


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


def _remove_unfinished(folder: Path, number: int) -> None:
    """Remove the unfinished files of owners with lower numbers, below a folder and of the folder itself."""
    for path in [*folder.rglob(".*.lease-*.tmp"), *folder.parent.glob(f".{folder.name}.lease-*.tmp")]:
        owner = re.search(r"\.lease-(\d+)\.[0-9a-f]+\.tmp$", path.name)
        if owner is None or int(owner[1]) >= number:  # a later owner's, if this process was frozen meanwhile
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _lease_of(path: Path) -> Lease | None:
    """Return the lease of the folder that contains the path; None if this process holds none."""
    resolved = _resolved(path)
    return next((_leases[one] for one in (resolved, *resolved.parents) if one in _leases), None)


def _resolved(path: Path) -> Path:
    """Return the path with the links in its folder resolved; its last part stays as it is."""
    return Path(os.path.realpath(path.parent)) / path.name


def _to_stderr(line: str) -> None:
    print(f"memmlp: {line}", file=sys.stderr, flush=True)
