"""This process and its children: garbage collection, signals, imports, and its share of a core."""

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

MIN_CORE_SHARE = 0.9  # with less of a core, other work disturbed a measurement


def collect_garbage_rarely() -> None:
    """Make the garbage collector run rarely, and not at the process' end.

    Call this at the start of a process. Importing torch makes hundreds of thousands of objects, none of which
    is garbage; searching them repeatedly takes a third of the time of a command that does little else.
    """
    gc.set_threshold(*GC_THRESHOLDS)
    atexit.register(gc.freeze)


@contextlib.contextmanager
def finish_uninterrupted(finish: Callable[[], object]) -> Iterator[None]:
    """Call a function at the end of the context, even if another Ctrl-C or SIGTERM arrives meanwhile."""
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
def termination_interrupts() -> Iterator[None]:
    """Treat a request to end (SIGTERM) like a Ctrl-C."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def import_environment() -> dict[str, str]:
    """Return the environment variables by which another Python process imports what this one does.

    Without them, `python -m` looks into the working folder first, where another copy of the package may lie.
    The standard library and site-packages are left out, because a job may start another interpreter on its
    way (`conda activate` on a cluster).
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
def children_import_the_same() -> Iterator[None]:
    """Set `import_environment` within the context, for libraries that pass on this process' environment."""
    before = {name: os.environ.get(name) for name in import_environment()}
    os.environ.update(import_environment())
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class CoreClock:
    """Measures for how much of the time since its creation the calling thread had a core.

    Other threads don't count: it is right where the calling thread does all the work, as in a session of
    ONNX Runtime on one thread.
    """

    def __init__(self) -> None:
        self._start, self._busy = time.perf_counter(), time.thread_time()

    @property
    def share(self) -> float:
        """The share so far, 0 to 1."""
        return (time.thread_time() - self._busy) / (time.perf_counter() - self._start)
