"""Loggers that are down or slow: the run goes on, nothing is shown twice, and a sync fills in the rest."""

import contextlib
import threading
from pathlib import Path

import pytest
from fake_logger import FakeLogger, Server, a_run, losses
from processes import until

from memmlp.common.files import write_json
from memmlp.runs.loggers import logger as module
from memmlp.runs.loggers.logger import LogReader, RunLogger, Session, read_run_facts, show_run, sync_runs
from memmlp.runs.lookup import add_tags
from memmlp.runs.run import Run


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PACE", 0.005)
    monkeypatch.setattr(module, "MAX_PAUSE", 0.02)


def loggers_of(*servers: Server) -> list[RunLogger]:
    return [FakeLogger(server, f"fake{n}") for n, server in enumerate(servers)]


def test_without_loggers_there_is_no_thread_and_no_file(tmp_path: Path):
    run, threads = a_run(tmp_path), threading.active_count()
    with show_run(run, loggers_of()):
        assert threading.active_count() == threads
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_run_is_shown_while_it_goes_on_and_to_its_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run, server = a_run(tmp_path), Server()
    with show_run(run, loggers_of(server)):
        until(lambda: server.values.get(run.id) == losses(3), "the curve so far")
        assert server.status[run.id] == "running"
        run.log(4, {"loss": 1 / 4})
        until(lambda: server.values[run.id] == losses(4), "the next value")
        run.finish([])
    assert (server.status[run.id], server.values[run.id], server.begun) == ("done", losses(4), 1)
    assert capsys.readouterr().err == ""


def test_a_failure_of_the_run_is_shown_and_a_run_that_never_began_is_not(tmp_path: Path):
    run, server = a_run(tmp_path), Server()
    run.fail("why")
    with contextlib.suppress(KeyError), show_run(run, loggers_of(server)):
        raise KeyError
    with show_run(Run.from_id(tmp_path, "1" * 16), loggers_of(server)):
        pass
    assert server.status == {run.id: "failed"}


def test_a_server_that_comes_back_has_everything_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Values whose receipt was lost are among them. The server of another logger stays down."""
    run, server = a_run(tmp_path), Server(drops=True)
    with show_run(run, loggers_of(server, Server(down=True))):
        until(lambda: server.begun == 2 and server.values[run.id] == losses(3), "the curve, once")
        server.down = True
        run.log(4, {"loss": 1 / 4})
        module.time.sleep(0.1)
        server.down = False
        until(lambda: server.values[run.id] == losses(4), "what was missed")
        run.finish([])
    assert run.done
    assert (server.status[run.id], server.values[run.id]) == ("done", losses(4))
    said = sorted(capsys.readouterr().err.splitlines())
    assert len(said) == 2
    for name, why, line in zip(
        ("fake0", "fake1"), ("connection reset", "connection refused"), said, strict=True
    ):
        assert f"run {run.id} is not shown in {name}: {why}; run memmlp loggers sync" in line


def test_a_logger_that_hangs_holds_up_neither_the_run_nor_another(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr(module, "MAX_WAIT", 0.3)
    hung, other = Server(gate=threading.Event()), Server()
    run = a_run(tmp_path)
    with show_run(run, loggers_of(hung, other)):
        run.finish([])
    until(lambda: other.status.get(run.id) == "done", "the other's end")
    assert capsys.readouterr().err.count("not shown in fake0: the logger is too slow") == 1
    hung.gate.set()
    until(lambda: len(hung.fingerprints) == 1, "the end, late")


def test_a_resumed_run_that_repeats_steps_is_replaced_at_its_end(tmp_path: Path):
    run, server = a_run(tmp_path), Server()
    session = Session(FakeLogger(server), run)
    session.update()
    run.log(3, {"loss": 9.0})
    session.update()
    session.end()
    assert (server.values[run.id], server.begun) == ([*losses(2), ("train/loss", 3, 9.0)], 2)


def test_a_sync_shows_what_changed_once(tmp_path: Path):
    logger, said = FakeLogger(), []
    runs = [a_run(tmp_path, "0" * 16), a_run(tmp_path, "1" * 16)]
    runs[0].finish([])
    runs[1].fail("why")
    assert sync_runs(logger, runs, said.append) == {"shown": 2}
    assert sync_runs(logger, runs, said.append) == {"same": 2}
    assert logger.server.status == {runs[0].id: "done", runs[1].id: "failed"}
    add_tags(runs[0], ["good"])
    assert sync_runs(logger, runs, said.append) == {"shown": 1, "same": 1}
    logger.server.fingerprints.clear()
    assert sync_runs(logger, runs, said.append) == {"shown": 2}
    assert (logger.server.values, said) == ({run.id: losses(3) for run in runs}, [])


def test_a_sync_leaves_runs_in_progress_and_tells_what_fails(tmp_path: Path):
    logger, said = FakeLogger(), []
    live, bad, good = (a_run(tmp_path, name * 16) for name in "012")
    bad.config_path.write_text("{")
    with live.lock():
        assert sync_runs(logger, [live, bad, good], said.append) == {"live": 1, "failed": 1, "shown": 1}
    assert "config.yaml" in said[0]


def test_a_tail_reads_the_last_of_repeated_steps_and_then_what_follows(tmp_path: Path):
    run = a_run(tmp_path)
    run.log(3, {"loss": 9.0})
    tail = LogReader(run)
    assert [(p.step, p.value) for p in tail.read()] == [(1, 1.0), (2, 0.5), (3, 9.0)]
    assert tail.read() == []
    run.log(4, {"loss": 4.0})
    assert [(p.key, p.step) for p in tail.read()] == [("train/loss", 4)]
    assert not tail.repeated
    run.log(4, {"loss": 5.0})
    assert [p.value for p in tail.read()] == [5.0]
    assert tail.repeated
    whole = run.metrics_path.read_bytes().splitlines(keepends=True)[0]
    with open(run.metrics_path, "ab", buffering=0) as file:
        file.write(whole[:10])
        assert tail.read() == []
        file.write(whole[10:])
    assert [p.step for p in tail.read()] == [1]


def test_the_fingerprint_changes_with_all_that_is_shown(tmp_path: Path):
    run = a_run(tmp_path)
    seen = {read_run_facts(run).fingerprint}
    for change in (
        lambda: run.log(4, {"loss": 1.0}), lambda: add_tags(run, ["a"]),
        lambda: write_json(run.results_path, {"a": 1.0}), lambda: run.fail("why"),
    ):  # fmt: skip
        change()
        now = read_run_facts(run).fingerprint
        assert now not in seen
        seen.add(now)
    assert read_run_facts(run).fingerprint == now
