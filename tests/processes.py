"""Processes that tests start; all of them end with their test file."""

import contextlib
import multiprocessing
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

MARK = "MEMMLP_TESTS"
PATIENCE = 900.0  # seconds until a wait fails, even on a very busy machine
SERVERS = (b"multiprocessing.resource_tracker", b"multiprocessing.forkserver")  # they end with this process
PRELOADED = [
    "memmlp.cli.main", "memmlp.config.build", "memmlp.training.run_stages", "memmlp.deploy.export",
    "torch._dynamo", "scipy.interpolate", "digested",
]  # fmt: skip


def mark() -> None:
    """Mark the environment of all processes that this one starts, by which `end_all` finds them. The marks of
    xdist's workers begin with that of their controller, which therefore finds the workers' too."""
    os.environ[MARK] = f"{os.environ.get(MARK, '')}/{os.getpid()}"


def marked() -> list[int]:
    """The numbers of the living processes with this process' mark; none without /proc."""
    wanted, found = f"\0{MARK}={os.environ[MARK]}".encode(), []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended, or belongs to another user
            environment, command = (folder / "environ").read_bytes(), (folder / "cmdline").read_bytes()
            if wanted in b"\0" + environment and not any(name in command for name in SERVERS):
                found.append(int(folder.name))
    return [pid for pid in found if pid != os.getpid()]


def end_all() -> None:
    """Kill the processes with this process' mark, and those that they start meanwhile."""
    end = time.monotonic() + PATIENCE
    while pids := marked():
        assert time.monotonic() < end, f"processes {pids} do not end"
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.01)


@contextlib.contextmanager
def started(line: Sequence[str], **options: Any) -> Iterator[subprocess.Popen]:
    """A process, with `subprocess.Popen`'s options, that is killed at the end if it has not ended."""
    with subprocess.Popen(line, **options) as process:
        try:
            yield process
        finally:
            process.kill()


def finished(line: Sequence[str], **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(line, capture_output=True, text=True, check=False, timeout=PATIENCE, **options)


class Forked(ForkServerProcess):
    """A process that calls a function, with the interface of `subprocess.Popen`. It is forked off a server
    that has imported torch and memmlp once, which takes seconds of CPU time."""

    returncode = ForkServerProcess.exitcode

    def __init__(self, work: Callable[..., object], *arguments: Any, said: str = os.devnull, **changes: str):
        multiprocessing.set_forkserver_preload(PRELOADED)
        super().__init__(target=_call, args=(said, {**os.environ, **changes}, work, arguments))
        self.start()

    def poll(self) -> int | None:
        return self.exitcode

    def wait(self, timeout: float = PATIENCE) -> int | None:
        self.join(timeout)
        return self.exitcode


def _call(said: str, environment: dict[str, str], work: Callable, arguments: Sequence[Any]) -> None:
    os.environ.clear()
    os.environ.update(environment)
    file = os.open(said, os.O_WRONLY | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(file, stream)
    work(*arguments)


@contextlib.contextmanager
def forked(work: Callable[..., object], *arguments: Any, **options: str) -> Iterator[Forked]:
    """A process that calls a function of a test module, killed at the end if it has not ended.

    Args:
        work: the function.
        arguments: its arguments.
        options: `said`, the file of both output streams, and changes of the environment.
    """
    process = Forked(work, *arguments, **options)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextlib.contextmanager
def interrupts(handler: Any) -> Iterator[None]:
    """Handle SIGINT this way in processes that start herein."""
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


hearing_interrupts = partial(interrupts, signal.default_int_handler)
"""Start processes as from a terminal, even if this one ignores SIGINT (nohup, or `&`)."""

ignoring_interrupts = partial(interrupts, signal.SIG_IGN)
"""Start processes as nohup does: they ignore SIGINT unless they handle it."""


def until(condition: Callable[[], T], what: str, process: subprocess.Popen | Forked | None = None) -> T:
    """The first true value of a condition; fails if `process` ends before."""
    end = time.monotonic() + PATIENCE
    while True:
        ended = process is not None and process.poll() is not None  # before the condition is evaluated
        if value := condition():
            return value
        assert not ended, f"the process ended with {process.returncode} before {what}"
        assert time.monotonic() < end, f"not within {PATIENCE:.0f} s: {what}"
        time.sleep(0.03)
