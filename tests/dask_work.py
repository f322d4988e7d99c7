"""What workers of Dask do in tests: importable where they run."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any


def stay(folder: Path) -> None:
    """Write which process of Dask's this one is of, in a file with its own number, and stay."""
    mine = folder / f"{os.getpid()}.tmp"
    mine.write_text(str(os.getppid()))
    mine.rename(mine.with_suffix(".txt"))
    threading.Event().wait()


def tasks(dask_worker: Any) -> list[str]:
    """The states of a worker's tasks."""
    return [task.state for task in dask_worker.state.tasks.values()]
