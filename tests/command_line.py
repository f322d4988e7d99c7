"""`memmlp` as a person types it, on runs of a few steps."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch
from processes import forked
from small_pictures import draw_small

from memmlp.cli.main import main

# For a process of its own. Ctrl-C reaches it where the tests were started with SIGINT ignored (nohup, &).
INTERRUPTIBLE = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
MAIN = [sys.executable, "-c", f"{INTERRUPTIBLE}; from memmlp.cli.main import main; main()"]
SIZES = ["model.depth=2"]
SMALL = [*SIZES, "data.synth.minutes=0.05"]  # smaller than profile=tiny
FEW = ["loggers=none", "threads=1", "optim.steps=6", "vqvae.steps=6"]
TINY = ["profile=tiny", *SIZES, "data.synth.minutes=0.1", *FEW]
BRIEF = ["profile=tiny", *SMALL, *FEW]  # half as much motion, where no run is looked at


def run(folder: Path, *arguments: str, code: int = 0) -> str:
    """What a command line in that folder prints, on both streams; it must exit with the code.

    In this process, which has torch and the exporter loaded already: half the time of a run of six steps.
    What starts workers goes apart, as they are reaped only with their controller.
    """
    said, threads = io.StringIO(), torch.get_num_threads()
    with contextlib.chdir(folder), contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        left = exit_code(arguments)
    torch.set_num_threads(threads)
    assert left == code, said.getvalue()
    return said.getvalue()


def exit_code(arguments: Sequence[str]) -> int:
    """That of a command line in this process and folder."""
    try:
        main(list(arguments))
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    return 0


def in_folder(folder: Path, *arguments: str) -> None:
    """What `processes.forked` does for a command line in that folder."""
    draw_small()
    os.chdir(folder)
    sys.exit(exit_code(arguments))


def run_apart(folder: Path, *arguments: str, code: int = 0) -> str:
    """The same in a process of its own, which has torch loaded already; the environment is this one's."""
    with tempfile.NamedTemporaryFile("r", encoding="utf-8") as said:
        with forked(in_folder, folder, *arguments, said=said.name, **os.environ) as process:
            left = process.wait()
        text = said.read()
    assert left == code, text
    return text
