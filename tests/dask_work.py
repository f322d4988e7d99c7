"""The work of Dask's workers in tests: a module that they can import."""

from __future__ import annotations

import os
import threading
from pathlib import Path


def stay(folder: Path) -> None:
    """Write the parent's process number into a file named after this process, and stay."""
    mine = folder / f"{os.getpid()}.tmp"
    mine.write_text(str(os.getppid()))
    mine.rename(mine.with_suffix(".txt"))
    threading.Event().wait()
