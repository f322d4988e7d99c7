"""A sweep under SIGKILLs: a short form of tests/benchmarks/chaos.py, and that its judge finds differences."""

from __future__ import annotations

import json
import random
import shutil
import signal
import subprocess
from pathlib import Path

import pytest
from benchmarks.chaos import check, compare, storm, sweep_storm
from command_line import SMALL
from kills.storms import forked_controllers

from memmlp.common.lease import current_process
from memmlp.runs.run import Run


@pytest.mark.slow
def test_a_sweep_under_kills_ends_as_an_undisturbed_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    forked_controllers(tmp_path, monkeypatch)
    overrides = [*SMALL, "export.graph=off"]
    assert sweep_storm(2, 3, 2, random.Random(0), overrides) == []


def test_a_storm_over_processes_that_end_at_once_ends_too(tmp_path: Path):
    """They live shorter than the pauses between kills, as a sweep's do whose runs are all done."""
    launched = []

    def launch() -> subprocess.Popen[bytes]:
        launched.append(subprocess.Popen(["sleep", "0.2"]))
        return launched[-1]

    try:
        storm([launch, launch], tmp_path, 2, (0.6, 0.8), random.Random(0))
    finally:
        for process in launched:
            process.kill()
    assert sorted(process.wait() for process in launched)[:2] == [-signal.SIGKILL] * 2


def finished(outputs: Path, name: str, weights: bytes = b"w") -> Run:
    run = Run.of(outputs, name * 16)
    run.begin("memmlp", {}, data="d", prerequisite=None)
    run.want([])  # no evaluation and no export
    run.model.write_bytes(weights)
    run.finish(["model.safetensors"])
    return run


def test_every_kind_of_difference_is_found(tmp_path: Path):
    calm, stormy = tmp_path / "calm", tmp_path / "stormy"
    for name in "abcde":
        finished(calm, name)
    shutil.copytree(calm, stormy)
    assert compare(calm, stormy) == []
    shutil.rmtree(Run.of(stormy, "a" * 16).folder)
    finished(stormy, "f")
    finished(stormy, "b", b"other")
    Run.of(stormy, "c" * 16).marker.unlink()
    claim = {**current_process(), "since": "now"}
    (Run.of(stormy, "d" * 16).folder / ".lease-1").write_text(json.dumps(claim))
    Run.of(stormy, "e" * 16).model.write_bytes(b"damaged")
    said = "\n".join(compare(calm, stormy))
    for line in (
        f"run {'a' * 16} is missing",
        f"run {'f' * 16} should not be",
        f"run {'b' * 16}: other weights",
        f"run {'c' * 16}: stopped, not done",
        f"run {'d' * 16}: is still held",
        f"run {'e' * 16}: artifact model.safetensors is missing or changed",
    ):
        assert line in said


def test_a_run_that_was_begun_again_after_its_end_is_found(tmp_path: Path):
    run = finished(tmp_path, "a")
    run.write_manifest({"attempts": [{"started": "2999-01-01T00:00:00+00:00", "stage": "training"}]})
    assert check(run.folder) == ["trained again after it was finished"]
