"""Where tests write: in memory, where there is plenty of it.

They make and remove tens of thousands of small files: a tenth of the time of some tests, on a disk.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from multiprocessing.util import Finalize
from pathlib import Path

MEMORY = Path("/dev/shm")
PLENTY = 8 * 2**30  # bytes: several times what the tests of all processes write
NAME = "mm-"  # short, as names of sockets below it may have a hundred characters; then the process' number


def scratch_in_memory(memory: Path = MEMORY, plenty: int = PLENTY) -> Path | None:
    """Make a folder in memory the place of temporary files, of this process and of those that it starts.

    What earlier processes left there, because a test of theirs failed, is removed.

    Returns:
        The folder, which this process has to remove; None where temporary files stay where they are: another
        process has chosen a place, there is no such memory, or not enough, or no program can be run there.
    """
    if "TMPDIR" in os.environ or not _has_room(memory, plenty):
        return None
    for left in memory.glob(f"{NAME}*"):
        number = left.name.removeprefix(NAME)
        if number.isdigit() and not Path(f"/proc/{number}").exists():
            shutil.rmtree(left, ignore_errors=True)
    scratch = memory / f"{NAME}{os.getpid()}"
    scratch.mkdir(mode=0o700)
    os.environ["TMPDIR"], tempfile.tempdir = str(scratch), None  # which is looked for anew
    return scratch


def remove_at_exit(scratch: Path) -> None:
    """Remove a folder at this process' end, after multiprocessing has removed its own folder below it."""
    Finalize(None, shutil.rmtree, args=(scratch,), kwargs={"ignore_errors": True}, exitpriority=-200)


def _has_room(memory: Path, plenty: int) -> bool:
    """Return whether there is enough memory, in which programs can be run."""
    with contextlib.suppress(OSError):
        state = os.statvfs(memory)
        return state.f_bavail * state.f_frsize >= plenty and not state.f_flag & os.ST_NOEXEC
    return False
