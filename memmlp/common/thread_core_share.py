"""How much of a measurement its thread had a core: if that is far less than all of it, others worked, too."""

from __future__ import annotations

import time

LEAST_CORE_SHARE = 0.9  # how much of a measurement the thread has to have a core for its times to be its own


class CoreClock:
    """Measures the share of the time since its making in which the calling thread had a core.

    Other threads don't count: it is right where the calling thread does all the work, as in a session of
    ONNX Runtime on one thread.
    """

    def __init__(self) -> None:
        self._begun, self._busy = time.perf_counter(), time.thread_time()

    @property
    def share(self) -> float:
        """The share so far, 0 to 1."""
        return (time.thread_time() - self._busy) / (time.perf_counter() - self._begun)
