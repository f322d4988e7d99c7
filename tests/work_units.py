"""What a test process takes at once: a file of tests, or all files that share what is dear to start."""

from __future__ import annotations

import functools
import re
from pathlib import Path

from xdist.scheduler import LoadFileScheduling

SHARED = {
    "the fork server": r"^from .* import .*\b(forked|forked_controllers|run_apart)\b",
    "the browser": r"^from chromium import",
    "MLflow": r"^ *from mlflow",
}
"""What each process that needs it starts or imports for seconds, and what is found in the files that do."""


class WorkUnits(LoadFileScheduling):
    """Distribution by file, but for the files that share something: they go to one process."""

    def _split_scope(self, nodeid: str) -> str:
        file = super()._split_scope(nodeid)
        return shared(self.config.rootpath / file) or file


@functools.cache
def shared(file: Path) -> str | None:
    """Return what a file of tests shares with others; None for nothing."""
    text = file.read_text(encoding="utf-8")
    return next((name for name, found in SHARED.items() if re.search(found, text, re.MULTILINE)), None)
