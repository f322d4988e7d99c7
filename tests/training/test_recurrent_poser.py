"""RecurrentPoser by one command."""

from pathlib import Path

import pytest

from memmlp.runs.lookup import list_runs

SHORT = [
    "profile=tiny",
    "data.synth.minutes=0.05",
    "loggers=none",
    "threads=1",
    "optim.steps=2",
    "export.graph=off",
]


@pytest.mark.slow
def test_one_command_trains_and_evaluates_it_and_a_mirror_makes_another_run(memmlp):
    ran = memmlp("train", "model=recurrent_poser", *SHORT)
    assert ran.code == 0, ran.err
    (plain,) = list_runs(Path("outputs"))
    assert plain.done
    assert plain.results["stream"]["rotation"] == plain.results["window"]["rotation"]
    assert plain.results["stream"]["rotation"]["MPJPE"] > 0
    assert plain.manifest["upstream"] is None
    assert "finished already" in memmlp("train", "model=recurrent_poser", *SHORT).out
    mirrored = ["data.mirror=true", "evaluation.modes=[stream]"]
    assert memmlp("train", "model=recurrent_poser", *SHORT, *mirrored).code == 0
    (other,) = (run for run in list_runs(Path("outputs")) if run.id != plain.id)
    assert other.manifest["data"] == plain.manifest["data"]
    assert other.model.read_bytes() != plain.model.read_bytes()
