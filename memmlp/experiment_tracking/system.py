"""What a run's machine does during the run: processor, memory, disk, network, GPUs, by psutil and NVML."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from memmlp.runs.run import Run

MB = 1e6


class Machine:
    """Measures the machine and a process on it; what is not installed or does not exist is left out.

    Args:
        pid: the process whose own memory and processor time are measured.
    """

    def __init__(self, pid: int):
        self.psutil, self.process = None, None
        with contextlib.suppress(Exception):  # not installed, or the process has ended
            import psutil

            self.psutil, self.process = psutil, psutil.Process(pid)
            psutil.cpu_percent()  # the first call begins the first interval
            self.process.cpu_percent()
        self.gpus = _gpus()

    def measure(self) -> dict[str, float]:
        """Return the measurements, in percent, megabytes and watts."""
        values: dict[str, float] = {}
        for part in (self._host, self._own, self._graphics):
            with contextlib.suppress(Exception):  # the process ended, a driver was unloaded, ...
                values.update(part())
        return values

    def _host(self) -> Iterator[tuple[str, float]]:
        if self.psutil is not None:
            memory, network = self.psutil.virtual_memory(), self.psutil.net_io_counters()
            yield "cpu_percent", self.psutil.cpu_percent()
            yield "memory_percent", memory.percent
            yield "memory_mb", memory.used / MB
            yield "disk_percent", self.psutil.disk_usage(".").percent
            yield "network_received_mb", network.bytes_recv / MB
            yield "network_sent_mb", network.bytes_sent / MB

    def _own(self) -> Iterator[tuple[str, float]]:
        if self.process is not None:
            yield "process_cpu_percent", self.process.cpu_percent()
            yield "process_memory_mb", self.process.memory_info().rss / MB

    def _graphics(self) -> Iterator[tuple[str, float]]:
        for number, gpu in enumerate(self.gpus):
            import pynvml

            memory = pynvml.nvmlDeviceGetMemoryInfo(gpu)
            yield f"gpu{number}_percent", float(pynvml.nvmlDeviceGetUtilizationRates(gpu).gpu)
            yield f"gpu{number}_memory_mb", memory.used / MB
            yield f"gpu{number}_watts", pynvml.nvmlDeviceGetPowerUsage(gpu) / 1000


def _gpus() -> list[Any]:
    """Return NVML's handles of the machine's GPUs; none without NVML."""
    with contextlib.suppress(Exception):
        import pynvml

        pynvml.nvmlInit()
        return [pynvml.nvmlDeviceGetHandleByIndex(i) for i in range(pynvml.nvmlDeviceGetCount())]
    return []


def next_sample(run: Run) -> int:
    """Return the number of the next sample of a run that may have been resumed."""
    path = run.folder / "system.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0
