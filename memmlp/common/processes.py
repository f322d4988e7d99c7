"""This process and its children: garbage collection, signals, imports, and CPU core usage."""

import atexit
import contextlib
import gc
import math
import os
import signal
import site
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")
GC_THRESHOLDS = (10_000, 20, 20)  # by default 700, 10 and 10

MIN_CORE_FRACTION = 0.9  # below this fraction of a core, other processes disturbed a measurement


def collect_garbage_rarely() -> None:
    """Make the garbage collector run rarely, and not when the process ends. Importing torch creates hundreds
    of thousands of live objects; scanning them takes a third of the time of a short command."""
    gc.set_threshold(*GC_THRESHOLDS)
    atexit.register(gc.freeze)


def count_usable_cores() -> int:
    """Return the number of cores that this process may use: affinity, cgroup quota, Slurm's allocation."""
    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # Slurm sets the number per task only if it was requested.
    slurm = os.environ.get("SLURM_CPUS_PER_TASK") or os.environ.get("SLURM_CPUS_ON_NODE", "")
    limits = [float(affinity), *_read_cgroup_quotas(), *([float(slurm)] if slurm.isdecimal() else [])]
    return max(math.ceil(min(limits)), 1)


def _read_cgroup_quotas(process: Path = Path("/proc/self/cgroup"), root: Path = CGROUPS) -> Iterator[float]:
    """Yield the CPU quotas, in cores, of the process's cgroups and their parents (versions 1 and 2)."""
    with contextlib.suppress(OSError):
        for line in process.read_text(encoding="utf-8").splitlines():
            _, controllers, name = line.split(":", 2)
            if controllers and "cpu" not in controllers.split(","):
                continue
            top = root / "cpu" if controllers else root
            group = top / name.lstrip("/")
            for folder in (group, *group.parents[: len(group.parts) - len(top.parts)]):
                files = ("cpu.cfs_quota_us", "cpu.cfs_period_us") if controllers else ("cpu.max",)
                with contextlib.suppress(OSError, ValueError):  # no such file, or "max"
                    words = " ".join((folder / file).read_text(encoding="utf-8") for file in files).split()
                    quota, period = map(float, words)
                    if quota > 0:
                        yield quota / period


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
    """Return environment variables with which another Python process imports the same modules. Without them,
    `python -m` searches the working folder first, which may contain another copy of the package. The standard
    library and site-packages are left out, because a job on a cluster may start another interpreter."""
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


class UsageTimer:
    """Measures CPU time and memory of this process, at most every INTERVAL seconds."""

    INTERVAL = 10.0

    def __init__(self) -> None:
        self._start, self._busy = time.monotonic(), time.process_time()

    def read(self) -> dict[str, float]:
        """Return the busy cores since the last result and the memory in GB; empty if it is too early."""
        now, busy = time.monotonic(), time.process_time()
        if now - self._start < self.INTERVAL:
            return {}
        cores = (busy - self._busy) / (now - self._start)
        self._start, self._busy = now, busy
        return {"CPU [cores]": round(cores, 2), "memory [GB]": round(_read_memory() / 1e9, 3)}


def _read_memory() -> int:
    """Return the memory of this process, bytes; its largest so far without /proc."""
    with contextlib.suppress(OSError):
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


class CoreUsageTimer:
    """Measures the fraction of time in which the calling thread ran on a CPU core. Use it only where this
    thread does all the work, such as in a single-threaded session of ONNX Runtime."""

    def __init__(self) -> None:
        self._start, self._busy = time.perf_counter(), time.thread_time()

    @property
    def fraction(self) -> float:
        """The fraction since this object was created, 0 to 1."""
        return (time.thread_time() - self._busy) / (time.perf_counter() - self._start)
