"""The lock of a run's folder: one by the kernel, and for people a file that says who holds it."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from filelock import FileLock, Timeout

from memmlp.common.files import now, read_json, write_json
from memmlp.runs.environment import host

HEARTBEAT = 5.0  # seconds between signs of life of a run's process
STALE = 60.0  # seconds without one after which a process on another machine counts as dead


class Lock:
    """The lock of a folder; a process may hold it several times, and loses it at once when it is killed.

    Attributes:
        folder: the folder.
        holder: the file that tells people who holds the lock; it is touched while they do.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.holder = folder / ".holder"

    @contextlib.contextmanager
    def hold(self, say: Callable[[str], None] | None = None, wait: bool = True) -> Iterator[bool]:
        """Hold the lock, and yield whether this process has it.

        Args:
            say: told in one line whom this process waits for; by default the line goes to stderr.
            wait: whether to wait while another process has the lock; otherwise False is yielded.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(self.folder / ".lock", is_singleton=True)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            if not wait:
                yield False
                return
            (say or _say)(f"run {self.folder.name} is in the hands of {self._who()}; waiting for it")
            lock.acquire()
        try:
            with self._heartbeat() if lock.lock_counter == 1 else contextlib.nullcontext():
                yield True
        finally:
            lock.release()

    @property
    def held(self) -> bool | None:
        """Whether the process that holds the lock is alive; None if no process claims to hold it."""
        holder = read_json(self.holder)
        return _lives(holder, self.holder) if holder else None

    def _who(self) -> str:
        holder = read_json(self.holder)
        return f"process {holder['pid']} since {holder['since']}" if holder else "another process"

    @contextlib.contextmanager
    def _heartbeat(self) -> Iterator[None]:
        """Write the holder's file, and touch it every few seconds while the lock is held."""
        ended = threading.Event()
        write_json(self.holder, {"pid": os.getpid(), "host": host(), "since": now()})
        thread = threading.Thread(target=_beat, args=(self.holder, ended), daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
            self.holder.unlink(missing_ok=True)


def _beat(holder: Path, ended: threading.Event) -> None:
    """Touch the holder's file until `ended` is set."""
    while not ended.wait(HEARTBEAT):
        with contextlib.suppress(OSError):
            os.utime(holder)


def _lives(holder: Mapping[str, object], path: Path) -> bool:
    """Return whether a holder's process is alive: on this machine by its id, elsewhere by its heartbeat."""
    if holder.get("host") == host():
        return _runs(int(str(holder["pid"])))
    try:
        return time.time() - path.stat().st_mtime < STALE
    except OSError:
        return False


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _say(line: str) -> None:
    print(f"memmlp: {line}", file=sys.stderr, flush=True)
