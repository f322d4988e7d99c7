"""`memmlp loggers sync`, and training with loggers, as a person types them."""

from pathlib import Path

import pytest
from conftest import Memmlp, one_line
from fake_logger import FakeLogger, Server, a_run

from memmlp.cli import loggers


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Server:
    """What is shown, by a logger in memory."""
    logger = FakeLogger()
    monkeypatch.setattr(loggers, "_make_loggers", lambda *_: [logger])
    return logger.server


def test_sync_shows_runs_and_then_nothing_more(memmlp: Memmlp, tmp_path: Path, server: Server):
    outputs = tmp_path / "outputs"
    a_run(outputs, "0" * 16).finish([])
    a_run(outputs, "1" * 16).fail("why")
    assert memmlp("loggers", "sync").out == "2 runs (2 updated now) are in memory\n"
    assert memmlp("loggers", "sync").out == "2 runs (0 updated now) are in memory\n"
    assert server.status == {"0" * 16: "done", "1" * 16: "failed"}


def test_what_could_not_be_shown_is_a_line_each(memmlp: Memmlp, tmp_path: Path, server: Server):
    a_run(tmp_path / "outputs")
    server.down = True
    ran = memmlp("loggers", "sync")
    assert ran.code == 1
    assert ran.err == f"memmlp: warning: run {'0' * 16} is not shown in fake: connection refused\n"
    assert one_line(memmlp("loggers", "sync", "--logger", "paper"), "paper", "mlflow", "tensorboard", "wandb")


def test_the_loggers_of_a_command_line(tmp_path: Path):
    found = loggers._make_loggers(["wandb", "mlflow", "tensorboard", "wandb"], tmp_path)
    assert [one.name for one in found] == ["wandb", "mlflow", "tensorboard"]
