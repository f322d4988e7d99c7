"""The processes of tests/benchmarks/chaos.py, without importing torch for each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from benchmarks import chaos
from command_line import in_folder
from processes import Forked


def forked_controllers(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Controllers and their workers are forked from now on, in a folder.

    That sweeps live and end as users start them is tests/cli/test_sweep.py's.
    """

    def start(words: Sequence[str], outputs: Path, workers: int) -> Forked:
        """What `chaos.start` does."""
        return Forked(in_folder, folder, *words, "--workers", str(workers), "--outputs", str(outputs))

    monkeypatch.setattr(chaos, "start", start)
