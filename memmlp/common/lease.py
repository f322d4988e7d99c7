"""Leases: only one process at a time owns a folder, even on file systems without locks.

To claim a folder, a process creates the file `.lease-N` with the next number; only one process can succeed.
The claim with the highest number is valid. Its owner touches the file every few seconds (heartbeat). To
release the folder, the owner renames its file to `.lease-N-free` with the next number. So numbers only grow.
The next claim may be made

- by any process, if the last claim is free or belongs to a dead process on this machine;
- by a process that has seen the last claim unchanged for LEASE, by its own clock. Clocks of different
  machines are never compared, since they may differ by hours.

A process that is frozen for longer than LEASE loses its folder, even if it continues later. Therefore it
checks its lease before it publishes a file there (`publish`, `check_owner`). The next owner first removes
the unfinished files of earlier owners. So a process that was frozen between check and rename publishes
nothing.

Kernel locks are not used: on network file systems they may be missing, or granted twice.
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

LEASE = 60.0  # seconds without a heartbeat after which other processes may take over a folder
BEAT = 5.0  # seconds between two heartbeats
MAX_CLAIM = 4096  # characters of a claim that are read
PAUSE = 0.2  # seconds between two attempts to claim a folder

PROC = Path("/proc")
ENDED = ("Z", "X")  # states of an ended process that its parent has not collected yet


@functools.cache
def compute_process_namespace() -> str:
    """Return a digest of machine, boot and container; together with it, a pid identifies a process."""
    try:
        namespace = os.readlink(PROC / "self/ns/pid")
    except OSError:
        namespace = ""
    parts = [platform.node(), _read_text(PROC / "sys/kernel/random/boot_id"), namespace]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def current_process() -> dict[str, Any]:
    """Describe this process; other processes can pass the description to `is_alive`."""
    _, born = _read_state_and_start(os.getpid())
    return {"pid": os.getpid(), "born": born, "place": compute_process_namespace()}


def is_alive(process: Mapping[str, Any]) -> bool | None:
    """Return whether a process (`current_process`) is alive; None if it runs on another machine."""
    if process.get("place") != compute_process_namespace():
        return None
    pid = process.get("pid")
    if not isinstance(pid, int) or not 0 < pid < 2**31:
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # the process belongs to another user
        pass
    state, born = _read_state_and_start(pid)
    return state not in ENDED and born == process.get("born")


def _read_state_and_start(pid: int) -> tuple[str, str] | tuple[None, None]:
    """Return the state of a process, and its start time in kernel ticks, which tells processes with the same
    pid apart; None without /proc."""
    fields = _read_text(PROC / str(pid) / "stat").rpartition(")")[2].split()
    return (fields[0], fields[19]) if fields else (None, None)


def _read_text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""


class ChangeTimer:
    """Measures for how long values have been unchanged, by a clock that never jumps."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self.clock = clock
        self.seen: dict[Hashable, tuple[object, float]] = {}

    def seconds_unchanged(self, key: Hashable, read: Callable[[], object]) -> float:
        """Read a value, and return a lower bound of the seconds since its last change; 0 at first."""
        before = self.clock()  # if this process is frozen while it reads, that time must not count
        value = read()
        last = self.seen.get(key)
        if last is None or last[0] != value:
            self.seen[key] = (value, self.clock())
            return 0.0
        return before - last[1]


_change_timer = ChangeTimer()
_leases: dict[Path, Lease] = {}
"""The leases of this process, by folder."""


class Claim(NamedTuple):
    """A claim on a folder, read from its file: its number, whether the owner has released the folder, the
    file's content, and the time of the last heartbeat, in nanoseconds of the file system's clock."""

    number: int
    free: bool
    text: str
    touched: int

    @property
    def owner(self) -> dict[str, Any] | None:
        """The process that made the claim; None if the folder is free or the claim is not readable (yet)."""
        with contextlib.suppress(ValueError, RecursionError):
            owner = json.loads(self.text)
            return owner if isinstance(owner, dict) and not self.free else None
        return None

    def can_be_taken_over(self, idle: float) -> bool:
        """Return whether another process may claim the folder after `idle` seconds."""
        return self.free or idle > LEASE or (self.owner is not None and is_alive(self.owner) is False)


class Lock:
    """The lock of a folder, or of its subfolder `name`; a thread that holds it may lock it again."""

    def __init__(self, folder: Path, name: str = ""):
        self.folder, self.target = folder, folder / name
        self.prefix = f".{name}.lease-" if name else ".lease-"
        self.description = f"{self.target.parent.name.removesuffix('s')} {self.target.name}"

    @contextlib.contextmanager
    def hold(self, wait: bool = True) -> Iterator[Lease | None]:
        """Hold the lock during the context, and yield the lease; without `wait`, None if another process
        holds the lock. If another process takes over the folder, publishing a file there raises LeaseLost.
        If this process has to wait, it prints a line to stderr."""
        key, thread = _resolve_folder(self.target), (os.getpid(), threading.get_ident())
        if key in _leases and _leases[key].thread == thread:
            yield _leases[key]
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        lease = self._try_to_claim()
        if lease is None and wait:
            holder = self.holder_description
            line = f"memmlp: {self.description} is in use by {holder}; waiting until it is free"
            print(line, file=sys.stderr, flush=True)
            while (lease := self._try_to_claim()) is None:
                time.sleep(PAUSE)
        if lease is None:
            yield None
            return
        with lease.keep_alive():
            _leases[key] = lease
            try:
                yield lease
            finally:  # before the release: another thread of this process may claim the folder after it
                del _leases[key]

    @property
    def owner(self) -> dict[str, Any] | None:
        """The process that holds the lock (`current_process`); None if it is unknown or the lock is free."""
        last = self._read_last_claim()
        return last.owner if last else None

    @property
    def holder_description(self) -> str:
        """A readable description of the process that holds the lock."""
        owner = self.owner
        if not owner:
            return "another process"
        where = "" if owner.get("place") == compute_process_namespace() else " on another machine"
        return f"process {owner.get('pid')}{where} since {owner.get('since')}"

    @property
    def is_held(self) -> bool | None:
        """Whether a live process holds the lock; False if its process died, None if the lock is free. A
        process on another machine counts as dead after LEASE without a heartbeat."""
        last, idle = self._read_last_claim_and_age()
        return None if last is None or last.free else not last.can_be_taken_over(idle)

    def _read_last_claim_and_age(self) -> tuple[Claim | None, float]:
        claims: list[Claim | None] = []

        def read() -> Claim | None:
            claims.append(self._read_last_claim())
            return claims[-1]

        idle = _change_timer.seconds_unchanged((self.folder.absolute(), self.prefix), read)
        return claims[-1], idle

    def _read_last_claim(self) -> Claim | None:
        while claims := self.list_claims():
            (number, owned), path = claims[-1]
            # A claim may have been superseded meanwhile. On NFS, opening a file refreshes it from the server.
            with (
                contextlib.suppress(FileNotFoundError),
                open(path, encoding="utf-8", errors="replace") as file,
            ):
                return Claim(number, not owned, file.read(MAX_CLAIM), os.fstat(file.fileno()).st_mtime_ns)
        return None

    def list_claims(self) -> list[tuple[tuple[int, bool], Path]]:
        """Return number, whether the folder is owned, and file of each claim, in ascending order."""
        try:
            names = os.listdir(self.folder)
        except FileNotFoundError:
            return []
        matches = (re.fullmatch(re.escape(self.prefix) + r"(\d+)(-free)?", name) for name in names)
        return sorted(((int(match[1]), not match[2]), self.folder / match[0]) for match in matches if match)

    def _try_to_claim(self) -> Lease | None:
        """Make the next claim if the folder can be taken over, and return the lease; otherwise None."""
        last, idle = self._read_last_claim_and_age()
        if last and not last.can_be_taken_over(idle):
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
        except OSError as error:
            path.unlink(missing_ok=True)
            error.filename = error.filename or str(path)
            raise
        finally:
            os.close(handle)
        *earlier, ((highest, _), _) = self.list_claims() or [((0, False), path)]
        if highest != number:  # this process was frozen meanwhile, and others made later claims
            path.unlink(missing_ok=True)
            return None
        for _, old in earlier:  # in ascending order: if interrupted, an old claim must not become the last
            old.unlink(missing_ok=True)
        _remove_unfinished(self.target, number)
        return Lease(self, number, path)


class Lease:
    """This process' claim on a folder. `lost` is set once it knows that another process has taken over."""

    def __init__(self, lock: Lock, number: int, path: Path):
        self.lock, self.number, self.path, self.lost = lock, number, path, False
        self.thread = (os.getpid(), threading.get_ident())

    def check(self) -> None:
        """Touch the claim. Raises LeaseLost if another process has made a later claim."""
        try:
            os.utime(self.path)
        except OSError as error:
            if error.errno not in (errno.ENOENT, errno.ESTALE):
                raise
            self.lost = True
        self.lost = self.lost or self.lock.list_claims()[-1:] != [((self.number, True), self.path)]
        if self.lost:
            raise LeaseLost(
                f"{self.lock.description}: another process took over the folder, because this process was "
                f"frozen for longer than {LEASE:.0f} s; this process writes nothing more to it"
            )

    @contextlib.contextmanager
    def keep_alive(self) -> Iterator[None]:
        """Touch the claim regularly during the context, then release the folder."""
        ended = threading.Event()

        def touch_regularly() -> None:
            while not (self.lost or ended.wait(BEAT)):
                with contextlib.suppress(OSError, LeaseLost):
                    self.check()

        thread = threading.Thread(target=touch_regularly, daemon=True)
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
    """Raise LeaseLost if this process has lost its lease of the path's folder. Call this before appending to
    a file or removing it. It can't detect a freeze between the check and the write."""
    if lease := _find_lease(path):
        lease.check()


def temporary_path(path: Path) -> Path:
    """Return a unique path, in the same folder, under which a file or folder is written before `publish`."""
    lease = _find_lease(path)
    owner = f".lease-{lease.number}" if lease else ""
    return path.with_name(f".{path.name}{owner}.{uuid.uuid4().hex[:12]}.tmp")


def publish(unfinished: Path, path: Path) -> None:
    """Move a finished file or folder from its `temporary_path` to its final path. Raises LeaseLost if this
    process has lost its lease of the path's folder."""
    check_owner(path)
    try:
        os.replace(unfinished, path)
    except FileNotFoundError:
        check_owner(path)  # the next owner removed the unfinished file
        raise


@contextlib.contextmanager
def publish_at_end(path: Path) -> Iterator[Path]:
    """Yield a `temporary_path` for a file or folder: at the end of the context it is published (`publish`),
    and after an error it is removed."""
    unfinished = temporary_path(path)
    try:
        yield unfinished
        publish(unfinished, path)
    finally:
        with contextlib.suppress(OSError):  # the disk may refuse this, too; the first error says why
            _remove(unfinished)


def _remove_unfinished(folder: Path, number: int) -> None:
    for path in [*folder.rglob(".*.lease-*.tmp"), *folder.parent.glob(f".{folder.name}.lease-*.tmp")]:
        owner = re.search(r"\.lease-(\d+)\.[0-9a-f]+\.tmp$", path.name)
        if owner and int(owner[1]) < number:  # not of a later owner
            _remove(path)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _find_lease(path: Path) -> Lease | None:
    """Return this process' lease of a folder that contains the path; None if there is no lease."""
    resolved = _resolve_folder(path)
    return next((_leases[one] for one in (resolved, *resolved.parents) if one in _leases), None)


def _resolve_folder(path: Path) -> Path:
    """Return the path with links in its parent folder resolved; a link at its end is kept."""
    return Path(os.path.realpath(path.parent)) / path.name
