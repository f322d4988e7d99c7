"""A baseline by one command."""

from pathlib import Path

import pytest
import tiny
from PIL import Image

from memmlp.config.build import build_experiment, config_of
from memmlp.deploy.parity import TOLERANCE, parity
from memmlp.runs.lookup import list_runs

NAMES = [name for name in tiny.BASELINES if name != "sage"]  # its parts are runs: test_sage.py
CLIP = tiny.clip(40)
SHORT = [
    "profile=tiny",
    "data.synth.minutes=0.04",
    "data.min_frames=26",
    "loggers=none",
    "threads=1",
    "optim.steps=2",
    "model.depth=2",
]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_one_command_trains_evaluates_and_finds_it_again(name, memmlp):
    """What is exported of each is compared in tests/deploy and tests/live; a picture is drawn below."""
    ran = memmlp("train", f"model={name}", *SHORT, "export.graph=off")
    assert ran.code == 0, ran.err
    (run,) = list_runs(Path("outputs"))
    assert run.done
    assert set(run.results) == {"window", "stream"}
    assert run.results["stream"]["rotation"]["MPJPE"] > 0
    assert run.manifest["upstream"] is None
    assert "finished already" in memmlp("train", f"model={name}", *SHORT, "export.graph=off").out


@pytest.mark.slow
def test_one_command_exports_it(memmlp, large_pictures):
    words = ["model=avatar_poser", *SHORT, "model.depth=1"]
    assert memmlp("train", *words).code == 0
    (run,) = list_runs(Path("outputs"))
    assert run.results["latency"]["onnx_parity"] <= TOLERANCE
    assert run.results["latency"]["macs"] > 0
    with Image.open(run.picture) as picture:
        assert picture.size[0] > 600
    loaded = build_experiment(config_of(run)).architecture.load(run.model)
    assert parity(loaded, run.onnx, CLIP) <= TOLERANCE
