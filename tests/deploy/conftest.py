"""What tests of deployments share."""

from pathlib import Path

import golden
import pytest
import tiny

from memmlp.networks.motion_model import MotionModel


@pytest.fixture
def small_yardstick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps are timed in turn with a computation that is over at once, not with 86 M multiply-adds."""
    monkeypatch.setattr("memmlp.deploy.latency.YARDSTICK_SHAPE", (2, 8, 1))


@pytest.fixture(scope="package")
def naive_step(tmp_path_factory: pytest.TempPathFactory) -> tuple[MotionModel, Path]:
    """A network as it was trained; streams are in exported.py."""
    path = tmp_path_factory.mktemp("onnx") / "step.onnx"
    path.write_bytes(golden.exported("graph.naive"))
    return tiny.model(), path
