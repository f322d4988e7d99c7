"""A training that went on elsewhere says so."""

from __future__ import annotations

from pathlib import Path

import pytest

from memmlp.runs.run import Run


def test_a_training_that_is_resumed_elsewhere_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Its weights come from both machines and both versions of the code."""
    run = Run.of(tmp_path, "0" * 16)

    def begin(device: str, commit: str, dirty: bool, losses: str) -> dict:
        made = {"git": {"commit": commit, "dirty": dirty}, "cpu": "A"}
        monkeypatch.setattr("memmlp.runs.run.environment", lambda: made)
        monkeypatch.setattr(
            "memmlp.runs.run.code_digests", lambda packages: {"losses.py": losses, "ik.py": "i"}
        )
        run.begin("memmlp", {}, data="d", upstream=None, device=device, threads=2)
        return run.manifest

    begin("cuda:0", "a" * 40, True, "old")
    assert begin("cpu", "b" * 40, False, "new")["device"] == "cpu"  # nothing was trained before
    run.checkpoint.touch()
    found = begin("cuda:0", "c" * 40, False, "newer")
    assert (found["device"], found["threads"], found["cpu"]) == ("cpu, cuda:0", 2, "A")
    assert found["git"] == {"commit": "c" * 40, "dirty": False, "before": "b" * 40}
    assert run.changed_sources == ["losses.py"]
