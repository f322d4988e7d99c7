"""This process and its children: garbage collection, signals, imports, and CPU core usage."""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import signal
import site
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator

GC_THRESHOLDS = (10_000, 20, 20)  # by default 700, 10 and 10

MIN_CORE_FRACTION = 0.9  # below this fraction of a core, other processes disturbed a measurement


def collect_garbage_rarely() -> None:
    """Make the garbage collector run rarely, and not when the process ends.

    Call this at the start of a process. Importing torch creates hundreds of thousands of live objects.
    Scanning them repeatedly takes a third of the time of a short command.
    """
    gc.set_threshold(*GC_THRESHOLDS)
    atexit.register(gc.freeze)


@contextlib.contextmanager
def finish_uninterrupted(finish: Callable[[], object]) -> Iterator[None]:
    """Call a function at the end of the context; Ctrl-C and SIGTERM are ignored while it runs."""
    try:
        yield
    finally:
        before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            finish()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextlib.contextmanager
def treat_termination_as_interrupt() -> Iterator[None]:
    """Treat SIGTERM like Ctrl-C during the context."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def build_import_variables() -> dict[str, str]:
    """Return environment variables with which another Python process imports the same modules.

    Without them, `python -m` searches the working folder first. It may contain another copy of the package.
    The standard library and site-packages are left out, because a job on a cluster may start another
    interpreter (`conda activate`).
    """
    library = sysconfig.get_path("stdlib")
    zipped = f"python{sys.version_info.major}{sys.version_info.minor}.zip"
    installed = (library, *site.getsitepackages(), site.getusersitepackages())
    given = [
        os.path.abspath(path)
        for path in sys.path
        if path not in installed
        and not path.startswith(library + os.sep)
        and os.path.basename(path) != zipped
    ]
    return {"PYTHONPATH": os.pathsep.join(given), "PYTHONSAFEPATH": "1"}


@contextlib.contextmanager
def pass_import_paths_to_children() -> Iterator[None]:
    """Set `build_import_variables` in this process during the context, so that child processes inherit it."""
    before = {name: os.environ.get(name) for name in build_import_variables()}
    os.environ.update(build_import_variables())
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class CoreUsageTimer:
    """Measures the fraction of time in which the calling thread ran on a CPU core.

    Other threads are not counted. Use it only where the calling thread does all the work, such as in a
    single-threaded session of ONNX Runtime.
    """

    def __init__(self) -> None:
        self._start, self._busy = time.perf_counter(), time.thread_time()

    @property
    def fraction(self) -> float:
        """The fraction since this object was created, 0 to 1."""
        return (time.thread_time() - self._busy) / (time.perf_counter() - self._start)
