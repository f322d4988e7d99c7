"""How often the garbage collector searches a process that imports torch."""

from __future__ import annotations

import atexit
import gc

THRESHOLDS = (10_000, 20, 20)  # by default 700, 10 and 10


def collect_seldom() -> None:
    """Make the garbage collector run rarely, and not at the process' end.

    Call this at the beginning of a process. Importing torch makes hundreds of thousands of objects, none of
    which is garbage; searching them repeatedly takes a third of the time of a command that does little else.
    """
    gc.set_threshold(*THRESHOLDS)
    atexit.register(gc.freeze)
