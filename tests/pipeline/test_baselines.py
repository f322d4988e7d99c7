"""A baseline by one command."""

from pathlib import Path

import pytest
import tiny

from memmlp.config.build import build_experiment, config_of
from memmlp.deploy.parity import TOLERANCE, parity
from memmlp.runs.lookup import list_runs

NAMES = list(tiny.BASELINES)
CLIP = tiny.clip(40)
SHORT = [
    "profile=tiny",
    "data.synth.minutes=0.2",
    "tracking=none",
    "threads=1",
    "optim.steps=2",
    "model.depth=2",
]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_one_command_does_it_all_and_finds_it_again(name, memmlp):
    ran = memmlp("train", f"model={name}", *SHORT)
    assert ran.code == 0, ran.err
    (run,) = list_runs(Path("outputs"))
    assert run.done
    assert set(run.results) == {"window", "stream", "latency"}
    assert run.results["stream"]["rotation"]["MPJPE"] > 0
    assert run.results["latency"]["onnx_parity"] <= TOLERANCE
    assert run.results["latency"]["macs"] > 0
    assert run.manifest["upstream"] is None
    assert "finished already" in memmlp("train", f"model={name}", *SHORT).out
    loaded = build_experiment(config_of(run)).architecture.load(run.model)
    assert parity(loaded, run.onnx, CLIP) <= TOLERANCE
