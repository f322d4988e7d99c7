"""`memmlp` as a person types it, on runs of a few steps."""

import contextlib
import io
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from PIL import Image
from processes import forked

from memmlp.cli.main import main
from memmlp.deploy import latency
from memmlp.training import run_stages

# For a process of its own. Ctrl-C reaches it even if the tests ignore SIGINT (nohup, &).
INTERRUPTIBLE = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
MAIN = [sys.executable, "-c", f"{INTERRUPTIBLE}; from memmlp.cli.main import main; main()"]
SIZES = ["model.depth=2"]
SMALL = [*SIZES, "data.synth.minutes=0.05"]  # smaller than profile=tiny
FEW = ["loggers=none", "threads=1", "optim.steps=6", "vqvae.steps=6"]
TINY = ["profile=tiny", *SIZES, "data.synth.minutes=0.1", *FEW]
BRIEF = ["profile=tiny", *SMALL, *FEW]  # half as much motion


def run(folder: Path, *arguments: str, code: int = 0, picture: bool = False) -> str:
    """The output of a command line in a folder, on both streams; it must exit with the code. It runs in this
    process, which has imported torch and the exporter: half the time of a run of six steps."""
    said, threads = io.StringIO(), torch.get_num_threads()
    with contextlib.chdir(folder), contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        left = exit_code(arguments, picture)
    torch.set_num_threads(threads)
    assert left == code, said.getvalue()
    return said.getvalue()


def exit_code(arguments: Sequence[str], picture: bool = False) -> int:
    """The exit code of a command line in this process and folder. Latency is compared with a small yardstick,
    and without `picture` the pictures of runs are of one pixel: together they are half the time of a tiny
    run."""
    with contextlib.ExitStack() as stack:
        shape = (*latency.YARDSTICK_SHAPE[:2], 1)
        stack.enter_context(mock.patch.object(latency, "YARDSTICK_SHAPE", shape))
        if not picture:
            stack.enter_context(mock.patch.object(run_stages, "draw_first_clip", _draw_one_pixel))
        try:
            main(list(arguments))
        except SystemExit as stop:
            return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    return 0


def _draw_one_pixel(model: Any, split: Any, path: Path) -> None:
    Image.new("RGB", (1, 1)).save(path)


def in_folder(folder: Path, *arguments: str) -> None:
    os.chdir(folder)
    sys.exit(exit_code(arguments))


def run_apart(folder: Path, *arguments: str, code: int = 0) -> str:
    """As `run`, in a process of its own, so that workers that it starts end with it."""
    with tempfile.NamedTemporaryFile("r", encoding="utf-8") as said:
        with forked(in_folder, folder, *arguments, said=said.name) as process:
            left = process.wait()
        text = said.read()
    assert left == code, text
    return text
