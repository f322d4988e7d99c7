"""A run and the process that follows it: whatever befalls the one, the other goes on."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import processes
import pytest
from fake_logger import FileLogger, a_run

from memmlp.experiment_tracking import follower_pipe
from memmlp.experiment_tracking.follower_pipe import Loggers, feed_of
from memmlp.runs.run import Run

PATIENCE = 300.0  # seconds; nothing comes near


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    """No feed is left to the next test."""
    yield
    for one in follower_pipe._FEEDS.values():
        one.close()
        if one.process is not None:
            one.process.kill()
            one.process.wait()
            one.listener.join()
    follower_pipe._FEEDS.clear()


def test_without_loggers_there_is_no_process_and_no_file(tmp_path: Path):
    loggers, run = Loggers((), tmp_path), a_run(tmp_path)
    with loggers.following(run):
        pass
    loggers.sweep(tmp_path)
    assert feed_of(loggers).process is None
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


@pytest.mark.slow
def test_runs_are_followed_by_one_process_to_their_ends(tmp_path: Path):
    loggers = Loggers((FileLogger(tmp_path / "shown"),), tmp_path)
    first, second = a_run(tmp_path, "0" * 16), a_run(tmp_path, "1" * 16)
    with loggers.following(first):
        first.finish([])
    second.fail("why")
    with contextlib.suppress(KeyError), loggers.following(second):
        raise KeyError
    followed = feed_of(loggers)
    for run in (first, second):
        assert followed.wait(run.folder, PATIENCE)
    lines = (tmp_path / "shown").read_text().splitlines()
    assert [line for line in lines if line.startswith("end")] == [
        f"end {first.id} done",
        f"end {second.id} failed",
    ]
    assert lines.count("train/loss 1 1") == 2
    followed.close()
    assert followed.process is not None
    assert followed.process.wait(PATIENCE) == 0


@pytest.mark.slow
def test_a_logger_that_hangs_costs_a_share_of_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    waited: list[float] = []
    monkeypatch.setattr(follower_pipe.Feed, "wait", lambda self, folder, seconds: waited.append(seconds))
    # The clock of this file alone: another thread that looks at the time takes none of its readings.
    clock = SimpleNamespace(monotonic=iter([0.0, 50.0, 1000.0, 90_000.0]).__next__)
    monkeypatch.setattr(follower_pipe, "time", clock)
    loggers, run = Loggers((FileLogger(tmp_path / "shown", hangs=True),), tmp_path), a_run(tmp_path)
    for _ in range(2):
        with loggers.following(run):
            run.log(9, {"loss": 1.0})
    assert waited == [0.5, follower_pipe.MOST]


@pytest.mark.slow
def test_a_follower_that_is_killed_harms_nothing_and_is_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    loggers, run = Loggers((FileLogger(tmp_path / "shown"),), tmp_path), a_run(tmp_path)
    with loggers.following(run):
        followed = feed_of(loggers)
        assert followed.process is not None
        followed.process.kill()
        followed.process.wait()
        run.finish([])
    assert followed.dropped == 1
    assert "is not shown" in capsys.readouterr().err
    with loggers.following(run):
        assert feed_of(loggers) is not followed
    assert feed_of(loggers).wait(run.folder, PATIENCE)
    assert (tmp_path / "shown").read_text().splitlines()[-1] == f"end {run.id} done"


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="no SIGSTOP here")
def test_a_follower_that_does_not_read_drops_events_and_blocks_nobody(tmp_path: Path):
    loggers = Loggers((FileLogger(tmp_path / "shown"),), tmp_path)
    followed = feed_of(loggers)
    assert followed.process is not None
    os.kill(followed.process.pid, signal.SIGSTOP)
    for _ in range(10_000):
        followed.tell("begin", tmp_path / "runs" / ("0" * 16))
    assert followed.dropped > 0
    os.kill(followed.process.pid, signal.SIGCONT)


def test_a_process_that_cannot_be_started_is_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "no-python"))
    loggers, run = Loggers((FileLogger(tmp_path / "shown"),), tmp_path), a_run(tmp_path)
    with loggers.following(run):
        pass
    err = capsys.readouterr().err
    assert err.startswith("memmlp: warning: runs are not shown by file: ")
    assert not (tmp_path / "shown").exists()


KILLED = """
import sys, os, signal
from pathlib import Path
from fake_logger import FileLogger, a_run
from memmlp.experiment_tracking.follower_pipe import Loggers
outputs = Path(sys.argv[1])
with Loggers((FileLogger(outputs / "shown"),), outputs).following(a_run(outputs)):
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_a_run_that_is_killed_is_shown_as_killed_and_its_follower_ends(tmp_path: Path):
    path = os.pathsep.join(filter(None, sys.path))
    processes.finished([sys.executable, "-c", KILLED, str(tmp_path)], env=os.environ | {"PYTHONPATH": path})
    end, shown = f"end {'0' * 16} killed", tmp_path / "shown"
    processes.until(lambda: shown.exists() and shown.read_text().splitlines()[-1:] == [end], "what was shown")
    processes.until(lambda: not processes.marked(), "the end of the follower")
    assert Run.of(tmp_path, "0" * 16).status == "stopped"
