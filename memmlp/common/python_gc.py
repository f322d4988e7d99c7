"""How often the garbage collector looks through a process that imports torch."""

from __future__ import annotations

import atexit
import gc

THRESHOLDS = (10_000, 20, 20)  # by default 700, 10 and 10


def collect_seldom() -> None:
    """Let the garbage collector look seldom, and no more at the process' end.

    For the beginning of a process. What torch imports is hundreds of thousands of objects, none of which is
    garbage; looking through them again and again is a third of the time of a command that does little else.
    """
    gc.set_threshold(*THRESHOLDS)
    atexit.register(gc.freeze)
