"""Loggers that are down or slow: the run goes on, nothing is shown twice, and a sync fills in the rest."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path

import pytest
from fake_logger import FakeLogger, Server, a_run, losses
from processes import until

from memmlp.runs.loggers import logger as module
from memmlp.runs.loggers.logger import Loggers, Session, sync
from memmlp.runs.notes import add_tags
from memmlp.runs.run import Run


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PACE", 0.005)
    monkeypatch.setattr(module, "MAX_PAUSE", 0.02)


def loggers_of(outputs: Path, *servers: Server) -> Loggers:
    return Loggers(tuple(FakeLogger(server, f"fake{n}") for n, server in enumerate(servers)), outputs)


def test_without_loggers_there_is_no_thread_and_no_file(tmp_path: Path):
    run, threads = a_run(tmp_path), threading.active_count()
    with loggers_of(tmp_path).following(run):
        assert threading.active_count() == threads
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_run_is_shown_while_it_goes_on_and_to_its_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run, server = a_run(tmp_path), Server()
    with loggers_of(tmp_path, server).following(run):
        until(lambda: server.values.get(run.id) == losses(3), "the curve so far")
        assert server.status[run.id] == "running"
        run.log(4, {"loss": 1 / 4})
        until(lambda: server.values[run.id] == losses(4), "the next value")
        run.finish([])
    assert (server.status[run.id], server.values[run.id], server.begun) == ("done", losses(4), 1)
    assert capsys.readouterr().err == ""


def test_a_failure_of_the_run_is_shown(tmp_path: Path):
    run, server = a_run(tmp_path), Server()
    run.fail("why")
    with contextlib.suppress(KeyError), loggers_of(tmp_path, server).following(run):
        raise KeyError
    assert server.status[run.id] == "failed"


def test_a_server_that_comes_back_has_everything_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Values whose receipt was lost are among them."""
    run, server = a_run(tmp_path), Server(drops=True)
    with loggers_of(tmp_path, server).following(run):
        until(lambda: server.begun == 2 and server.values[run.id] == losses(3), "the curve, once")
        server.down = True
        run.log(4, {"loss": 1 / 4})
        module.time.sleep(0.1)
        server.down = False
        until(lambda: server.values[run.id] == losses(4), "what was missed")
        run.finish([])
    assert (server.status[run.id], server.values[run.id]) == ("done", losses(4))
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert f"run {run.id} is not shown in fake0: connection reset; memmlp loggers sync" in said[0]


def test_a_logger_that_stays_down_costs_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run, server = a_run(tmp_path), Server(down=True)
    with loggers_of(tmp_path, server).following(run):
        module.time.sleep(0.1)
        run.finish([])
    assert run.done
    assert capsys.readouterr().err.count("not shown in fake0") == 1


def test_a_logger_that_hangs_holds_up_neither_the_run_nor_another(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr(module, "MAX_WAIT", 0.3)
    hung, other = Server(gate=threading.Event()), Server()
    run = a_run(tmp_path)
    with loggers_of(tmp_path, hung, other).following(run):
        run.finish([])
    until(lambda: other.status.get(run.id) == "done", "the other's end")
    assert capsys.readouterr().err.count("not shown in fake0: it is too slow") == 1
    hung.gate.set()
    until(lambda: len(hung.fingerprints) == 1, "the end, late")


def test_a_resumed_run_that_repeats_steps_is_replaced_at_its_end(tmp_path: Path):
    run, server = a_run(tmp_path), Server()
    session = Session(FakeLogger(server), run)
    session.update()
    run.log(3, {"loss": 9.0})
    session.update()
    session.end()
    assert server.values[run.id] == [*losses(2), ("train/loss", 3, 9.0)]
    assert server.begun == 2


def test_a_run_that_never_began_is_not_shown(tmp_path: Path):
    server = Server()
    with loggers_of(tmp_path, server).following(Run.of(tmp_path, "1" * 16)):
        pass
    assert server.status == {}


def test_a_sync_shows_what_changed_once(tmp_path: Path):
    logger, said = FakeLogger(), []
    runs = [a_run(tmp_path, "0" * 16), a_run(tmp_path, "1" * 16)]
    runs[0].finish([])
    runs[1].fail("why")
    assert sync(logger, runs, said.append) == {"shown": 2}
    assert sync(logger, runs, said.append) == {"same": 2}
    assert logger.server.status == {runs[0].id: "done", runs[1].id: "failed"}
    add_tags(runs[0], ["good"])
    assert sync(logger, runs, said.append) == {"shown": 1, "same": 1}
    assert sync(logger, runs, said.append, full=True) == {"shown": 2}
    logger.server.fingerprints.clear()
    assert sync(logger, runs, said.append) == {"shown": 2}
    assert logger.server.values == {run.id: losses(3) for run in runs}
    assert said == []


def test_a_sync_leaves_runs_in_progress_and_tells_what_fails(tmp_path: Path):
    logger, said = FakeLogger(), []
    live, bad, good = (a_run(tmp_path, name * 16) for name in "012")
    bad.config_path.write_text("{")
    with live.lock():
        assert sync(logger, [live, bad, good], said.append) == {"live": 1, "failed": 1, "shown": 1}
    assert "config.yaml" in said[0]
