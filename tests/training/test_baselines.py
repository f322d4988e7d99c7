"""A baseline by one command."""

from pathlib import Path

import pytest

from memmlp.runs.lookup import list_runs

SHORT = [
    "profile=tiny", "data.synth.minutes=0.04", "data.min_frames=26", "loggers=none", "threads=1",
    "optim.steps=2", "model.depth=2", "export.graph=off",
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param("manikin_s", marks=pytest.mark.long), "recurrent_poser"])
def test_one_command_trains_evaluates_and_finds_it_again(name, memmlp):
    """What is exported of each is compared in tests/deploy and tests/live."""
    ran = memmlp("train", f"model={name}", *SHORT)
    assert ran.code == 0, ran.err
    (run,) = list_runs(Path("outputs"))
    assert run.done
    assert set(run.results) == {"window", "stream"}
    assert run.results["stream"]["rotation"]["MPJPE"] > 0
    if name == "recurrent_poser":  # which sees all frames before, in either mode
        assert run.results["stream"]["rotation"] == run.results["window"]["rotation"]
    assert run.manifest["prerequisite"] is None
    assert "finished already" in memmlp("train", f"model={name}", *SHORT).out
