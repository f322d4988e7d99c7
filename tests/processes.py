"""Processes that tests start, which end with the tests, however those end."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import subprocess
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from forked_workers import address, fork_workers

T = TypeVar("T")

MARK = "MEMMLP_TESTS"
PATIENCE = 900.0  # seconds until a wait fails: nothing comes near, on a machine with much other work either
PROC = Path("/proc")
SERVANTS = (b"multiprocessing.resource_tracker", b"multiprocessing.forkserver")  # they end with this process


def mark() -> None:
    """Set the environment variable by which the processes are found that this one starts.

    Those that they start in turn inherit it, in whatever session: a sweep's workers among them. The mark of
    a test process begins with that of the one that distributes the tests, which so finds all.
    """
    os.environ[MARK] = f"{os.environ.get(MARK, '')}/{uuid.uuid4().hex}"
    if not BEGUN:
        BEGUN.update(os.environ)
    OLDER.update(_entries())
    FOREIGN.clear()


BEGUN: dict[str, str] = {}
"""The environment at the first mark, before any test changed it."""

OLDER: set[tuple[str, int]] = set()
"""The processes from before the mark, which they cannot have. A number given anew has a new inode."""

FOREIGN: dict[tuple[str, int], float] = {}
"""Since when a process is known that does not have the mark. It may get it by starting another program."""

SETTLED = 30.0  # seconds after which a process without the mark is taken for somebody else's


def _entries() -> set[tuple[str, int]]:
    """The numbers and inodes of all processes. None where there is no /proc."""
    with contextlib.suppress(FileNotFoundError):
        return {(entry.name, entry.inode()) for entry in os.scandir(PROC) if entry.name.isdigit()}
    return set()


def marked() -> list[int]:
    """The numbers of the living processes with this process' mark, without itself.

    None where there is no /proc.
    """
    wanted, now = f"\0{MARK}={os.environ[MARK]}".encode(), time.monotonic()
    found = []
    for entry in _entries() - OLDER:
        folder = PROC / entry[0]
        with contextlib.suppress(OSError):  # it has ended, or is somebody else's
            if wanted not in b"\0" + (folder / "environ").read_bytes():
                if now - FOREIGN.setdefault(entry, now) > SETTLED:
                    OLDER.add(entry)
                continue
            command = (folder / "cmdline").read_bytes()
            if not any(name in command for name in SERVANTS):
                found.append(int(folder.name))
    return [pid for pid in found if pid != os.getpid()]


def end_all() -> None:
    """Kill the processes with this process' mark, and what they start meanwhile."""
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


PRELOADED = [
    "memmlp.config.build", "memmlp.training.run_stages", "memmlp.deploy.export", "memmlp.motion.synthetic",
    "memmlp.report.pictures.clip_pictures", "torch.onnx", "torch._dynamo",
    "memmlp.cli.sweep", "memmlp.config.worker_process", "memmlp.sweep.controller",
    "memmlp.sweep.executors.local", "memmlp.report.tables.build_table",
    "memmlp.cli.tune", "memmlp.sweep.search.director", "memmlp.sweep.search.results", "optuna.importance",
    "optuna.visualization",
    "warm_server",
]  # fmt: skip
"""What a training imports, its optimiser, its export and its picture included; what a sweep and a search do
beside it; what else is done once."""


class Forked:
    """A process that calls a function, with what tests need of `subprocess.Popen`.

    What it says goes into the file `said`, by default nowhere. It is forked off a server that has imported
    torch and memmlp once, which takes seconds of CPU time.
    """

    def __init__(
        self, work: Callable[..., object], *arguments: Any, said: str = os.devnull, **environment: str
    ):
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(PRELOADED)
        with _as_begun():
            server = address()
        self._process = context.Process(target=_saying, args=(server, said, environment, work, arguments))
        self._process.start()

    @property
    def pid(self) -> int | None:
        """The process' number."""
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """The exit code, negative where a signal ended the process; None while it lives."""
        return self._process.exitcode

    def poll(self) -> int | None:
        """As `returncode`."""
        return self.returncode

    def kill(self) -> None:
        """Send SIGKILL."""
        self._process.kill()

    def wait(self, timeout: float = PATIENCE) -> int | None:
        """Return the exit code once the process has ended."""
        self._process.join(timeout)
        return self.returncode


@contextlib.contextmanager
def _as_begun() -> Iterator[None]:
    """A server that starts herein has the environment of the beginning, and finds the modules of the tests.

    What the first test that forks has set is not found by the others. The path it takes back itself.
    """
    now = dict(os.environ)
    begun = BEGUN or now
    path = os.pathsep.join([str(Path(__file__).parent), begun.get("PYTHONPATH", "")])
    _become({**begun, "PYTHONPATH": path})
    try:
        yield
    finally:
        _become(now)


def _become(environment: dict[str, str]) -> None:
    for name in os.environ.keys() - environment.keys():
        del os.environ[name]
    os.environ.update(environment)


def _saying(
    server: str, said: str, environment: dict[str, str], work: Callable[..., object], arguments: Sequence[Any]
) -> None:
    fork_workers(server)
    os.environ.update(environment)
    file = os.open(said, os.O_WRONLY | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(file, stream)
    work(*arguments)


@contextlib.contextmanager
def forked(work: Callable[..., object], *arguments: Any, **environment: str) -> Iterator[Forked]:
    """A process that calls a function of a module of the tests, killed at the end if it has not ended."""
    process = Forked(work, *arguments, **environment)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextlib.contextmanager
def hearing_interrupts() -> Iterator[None]:
    """As from a terminal: processes started herein hear SIGINT, where this one ignores it (nohup, or `&`)."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def ignoring_interrupts() -> Iterator[None]:
    """As in what nohup started: processes started herein ignore SIGINT, if they do nothing about it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def finished(line: Sequence[str], **options: Any) -> subprocess.CompletedProcess[str]:
    """What a process left that has ended by itself."""
    return subprocess.run(line, capture_output=True, text=True, check=False, timeout=PATIENCE, **options)


def until(condition: Callable[[], T], what: str, process: subprocess.Popen | Forked | None = None) -> T:
    """The first true value of a condition; fails where `process`, if one is given, ends without it."""
    end = time.monotonic() + PATIENCE
    while True:
        ended = process is not None and process.poll() is not None  # before the condition is looked at
        if value := condition():
            return value
        assert not ended, f"the process ended with {process.returncode} before {what}"
        assert time.monotonic() < end, f"not within {PATIENCE:.0f} s: {what}"
        time.sleep(0.03)
