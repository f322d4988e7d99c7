"""Machines of a test: threads that count as machines, which share a folder, but no clock and no locks."""

from __future__ import annotations

import contextlib
import os
import random
import threading
from collections.abc import Callable, Iterator, MutableMapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from memmlp.common import files, lease
from memmlp.common.lease import Changes


class Clock:
    """A clock that a test turns."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


class OwnChanges(threading.local):
    """What each machine has seen, by a clock that all of them read."""

    def __init__(self, clock: Clock):
        self.seconds_unchanged = Changes(clock).seconds_unchanged


class OwnLeases(threading.local, MutableMapping):
    """The leases of each machine."""

    def __init__(self) -> None:
        self.leases: dict[Path, Any] = {}

    def __getitem__(self, key: Path) -> Any:
        return self.leases[key]

    def __setitem__(self, key: Path, value: Any) -> None:
        self.leases[key] = value

    def __delitem__(self, key: Path) -> None:
        del self.leases[key]

    def __iter__(self) -> Iterator[Path]:
        return iter(self.leases)

    def __len__(self) -> int:
        return len(self.leases)


def apart(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Let every thread be a machine. Nothing beats by itself; the clock stands until it is turned."""
    clock = Clock()
    monkeypatch.setattr(lease, "process_space", lambda: threading.current_thread().name)
    monkeypatch.setattr(lease, "_changes", OwnChanges(clock))
    monkeypatch.setattr(lease, "_leases", OwnLeases())
    monkeypatch.setattr(lease, "BEAT", 1e6)
    return clock


class Machine:
    """A thread that does one thing after another, each when it is told to."""

    def __init__(self, name: str):
        self.wanted: Callable[[], object] | None = None
        self.result: object = None
        self.go, self.done = threading.Semaphore(0), threading.Semaphore(0)
        self.thread = threading.Thread(target=self._serve, name=name, daemon=True)
        self.thread.start()

    def __call__(self, action: Callable[..., Any], *arguments: Any) -> Any:
        """Do it there, and return what it returns, or raise what it raises."""
        self.wanted = lambda: action(*arguments)
        self.go.release()
        self.done.acquire()
        if isinstance(self.result, BaseException):
            raise self.result
        return self.result

    def _serve(self) -> None:
        while True:
            self.go.acquire()
            assert self.wanted is not None
            try:
                self.result = self.wanted()
            except BaseException as error:
                self.result = error
            self.done.release()


class Scheduler:
    """Lets one of several threads go at a time, from system call to system call, in an order drawn by lot."""

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
    """The lock held, which nobody else has."""
    with lock.hold(wait=False) as found:
        assert found is not None
        yield found


@contextlib.contextmanager
def fenced(folder: Path, fence: Any) -> Iterator[None]:
    """Let an object with `number` and `check` stand for this process' lease on a folder."""
    key = lease._resolved(folder)
    lease._leases[key] = fence
    try:
        yield
    finally:
        del lease._leases[key]
