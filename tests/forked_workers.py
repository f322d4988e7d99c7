"""Submitit's local workers, forked off the server that test processes fork from (processes.Forked).

Each would start two interpreters and import torch, which is most of what a sweep of six steps takes. All else
is as it is: the same functions, environment, logs and signals. Workers of processes that were started as
users start them (tests/cli/test_sweep, tests/sweep/executors) are submitit's own.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
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
    """From now on submitit's workers are forked off the server, as the process is that calls this."""
    from submitit.local import local

    forkserver._forkserver._forkserver_address = server
    forkserver._forkserver.ensure_running = lambda: None  # it is somebody else's
    local.subprocess = _Subprocess()


class _Subprocess:
    """Stands for the module `subprocess` in submitit.local.local."""

    @staticmethod
    def Popen(
        command: Sequence[str],
        env: Mapping[str, str],
        stdout: IO[Any] | None = None,
        stderr: IO[Any] | None = None,
        **options: Any,
    ) -> _Worker:
        assert not options.pop("shell"), "not forked"
        logs = [file.name if file else os.devnull for file in (stdout, stderr)]
        return _Worker(command, dict(env), logs)


class _Worker:
    """What submitit needs of `subprocess.Popen`."""

    def __init__(self, command: Sequence[str], environment: dict[str, str], logs: Sequence[str]):
        context = multiprocessing.get_context("forkserver")
        self.server = forkserver._forkserver._forkserver_address
        arguments = (self.server, list(command), environment, os.getcwd(), list(logs))
        self.process = context.Process(target=_worked, args=arguments)
        self.process.start()
        process._children.discard(self.process)  # it may outlive this process
        self.pid = self.process.pid

    def poll(self) -> int | None:
        """Return the exit code; None while it lives."""
        return self.process.exitcode

    def send_signal(self, number: int) -> None:
        """Send a signal."""
        if self.poll() is None:
            os.kill(self.pid, number)


def _worked(
    server: str, command: Sequence[str], environment: Mapping[str, str], folder: str, logs: Sequence[str]
) -> None:
    """Do what `python [-u] -m MODULE ARGUMENT` would."""
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    for stream, log in enumerate(logs, start=1):
        os.dup2(os.open(log, os.O_WRONLY | os.O_APPEND), stream)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL if number != signal.SIGINT else signal.default_int_handler)
    module, *arguments = command[list(command).index("-m") + 1 :]
    sys.argv = [module, *arguments]
    fork_workers(server)
    draw_small()
    if module == "submitit.local._local":
        from submitit.local.local import Controller

        Controller(Path(arguments[0])).run()
    else:
        from submitit.core.submission import submitit_main

        submitit_main()
