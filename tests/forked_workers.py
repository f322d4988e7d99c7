"""Local workers, forked off the server that test processes fork from (processes.Forked).

Each would start an interpreter and import torch, which is most of what a sweep of six steps takes. All else
is as it is: the same functions, environment, logs and signals. Workers of processes that were started as
users start them (tests/cli/test_sweep, tests/sweep/executors) are not forked.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from multiprocessing import forkserver, process
from pathlib import Path
from typing import IO, Any

from small_pictures import draw_small


def address() -> str:
    """Return where the server listens, which runs once a process was forked off it."""
    forkserver.ensure_running()
    return forkserver._forkserver._forkserver_address


def fork_workers(server: str) -> None:
    """From now on local workers are forked off the server, as the process is that calls this."""
    from memmlp.sweep.executors import local

    forkserver._forkserver._forkserver_address = server
    forkserver._forkserver.ensure_running = lambda: None  # it is somebody else's
    local.subprocess = _Subprocess()  # type: ignore[assignment]


class _Subprocess:
    """Stands for the module `subprocess` in memmlp.sweep.executors.local."""

    DEVNULL, PIPE = subprocess.DEVNULL, subprocess.PIPE

    @staticmethod
    def Popen(command: Sequence[str], env: Mapping[str, str], stdout: IO[Any], **options: Any) -> _Worker:
        assert options["stdin"] == subprocess.DEVNULL
        return _Worker(command, dict(env), stdout.name)


class _Worker:
    """What workers need of `subprocess.Popen`."""

    def __init__(self, command: Sequence[str], environment: dict[str, str], log: str):
        context = multiprocessing.get_context("forkserver")
        self.server = forkserver._forkserver._forkserver_address
        arguments = (self.server, list(command), environment, os.getcwd(), log)
        self.process = context.Process(target=_worked, args=arguments)
        self.process.start()
        process._children.discard(self.process)  # it may outlive this process
        self.pid = self.process.pid

    def poll(self) -> int | None:
        """Return the exit code; None while it lives."""
        return self.process.exitcode

    def wait(self) -> None:
        """Do nothing: it is not a child of this process."""

    def terminate(self) -> None:
        """Ask it to end."""
        if self.poll() is None:
            os.kill(self.pid, signal.SIGTERM)


def _worked(
    server: str, command: Sequence[str], environment: Mapping[str, str], folder: str, log: str
) -> None:
    """Do what `python -u -m memmlp.sweep.executors.local FOLDER` would."""
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    for stream in (1, 2):
        os.dup2(os.open(log, os.O_WRONLY | os.O_APPEND), stream)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL if number != signal.SIGINT else signal.default_int_handler)
    from memmlp.sweep.executors import local

    fork_workers(server)
    draw_small()
    with contextlib.suppress(KeyboardInterrupt):
        local.do_work(Path(command[-1]))
