"""Threads that count as machines, which share a folder, but neither clocks nor locks."""

import contextlib
import os
import random
import threading
from collections import UserDict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from memmlp.common import files, lease
from memmlp.common.lease import ChangeTimer


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


class OwnChanges(threading.local):
    """The changes that each machine has seen, by a common clock."""

    def __init__(self, clock: Clock):
        self.seconds_unchanged = ChangeTimer(clock).seconds_unchanged


class OwnLeases(threading.local, UserDict):
    """The leases of each machine."""


def apart(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Let every thread be a machine. No lease is renewed by itself, and the clock stands until it is set."""
    clock = Clock()
    monkeypatch.setattr(lease, "compute_process_namespace", lambda: threading.current_thread().name)
    monkeypatch.setattr(lease, "_change_timer", OwnChanges(clock))
    monkeypatch.setattr(lease, "_leases", OwnLeases())
    monkeypatch.setattr(lease, "BEAT", 1e6)
    return clock


class Machine:
    def __init__(self, name: str):
        self.thread = ThreadPoolExecutor(1, thread_name_prefix=name)

    def __call__(self, action: Callable[..., Any], *arguments: Any) -> Any:
        return self.thread.submit(action, *arguments).result()


class Scheduler:
    """Lets one of several threads run at a time, from system call to system call, in a random order."""

    CALLS = ("listdir", "open", "write", "utime", "replace")

    def __init__(self, monkeypatch: pytest.MonkeyPatch, clock: Clock, dice: random.Random, pause: float):
        self.clock, self.dice, self.pause = clock, dice, pause
        self.turns: dict[int, threading.Semaphore] = {}
        self.back = threading.Semaphore(0)
        calls = {name: self._stepping(getattr(os, name)) for name in self.CALLS}
        plain = {name: getattr(os, name) for name in dir(os) if not name.startswith("_")}
        proxy = SimpleNamespace(**{**plain, **calls, "fsync": lambda handle: None})
        for module in (lease, files):
            monkeypatch.setattr(module, "os", proxy)
        for name in ("unlink", "rename"):
            monkeypatch.setattr(Path, name, self._stepping(getattr(Path, name)))
        monkeypatch.setattr(files, "sync_folder", lambda folder: None)

    def _stepping(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def stepping(*arguments: Any, **options: Any) -> Any:
            if turn := self.turns.get(threading.get_ident()):
                self.back.release()
                turn.acquire()
            return call(*arguments, **options)

        return stepping

    def run(self, actors: dict[str, Callable[[], None]]) -> None:
        """Run the actors to their end, each as a machine of that name."""
        threads: dict[str, threading.Thread] = {}
        for name, actor in actors.items():
            turn = threading.Semaphore(0)
            threads[name] = threading.Thread(target=self._act, args=(actor, turn), name=name, daemon=True)
            threads[name].start()
            self.back.acquire()
            self.turns[threads[name].ident or 0] = turn
        while alive := [thread for thread in threads.values() if thread.ident in self.turns]:
            chosen = self.dice.choice(alive).ident or 0
            for _ in range(self.dice.randint(1, 25)):  # so long the others stand still
                self.clock.now += self.dice.choice((0.1, 1.0, self.pause))
                if turn := self.turns.get(chosen):
                    turn.release()
                    self.back.acquire()

    def _act(self, actor: Callable[[], None], turn: threading.Semaphore) -> None:
        self.back.release()
        turn.acquire()
        try:
            actor()
        finally:
            del self.turns[threading.get_ident()]
            self.back.release()


@contextlib.contextmanager
def taken(lock: lease.Lock) -> Iterator[lease.Lease]:
    """Hold a lock that nobody else holds."""
    with lock.hold(wait=False) as found:
        assert found is not None
        yield found


@contextlib.contextmanager
def fenced(folder: Path, fence: Any) -> Iterator[None]:
    """Use an object with `number` and `check` as this process' lease on a folder."""
    key = lease._resolve_folder(folder)
    lease._leases[key] = fence
    try:
        yield
    finally:
        del lease._leases[key]
