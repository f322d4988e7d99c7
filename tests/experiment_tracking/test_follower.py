"""Loggers that are down, slow or late: nothing is shown twice, nothing is lost, everything is told."""

from __future__ import annotations

import queue
from pathlib import Path
from typing import Any

import pytest
from fake_logger import FakeLogger, Server, a_run, losses

from memmlp.common.files import write_json
from memmlp.experiment_tracking import follower
from memmlp.experiment_tracking.follower import Desk, MachineLog, follow
from memmlp.experiment_tracking.logged_values import SYSTEM
from memmlp.experiment_tracking.run_logger import Session
from memmlp.runs.metrics_log import MetricsLog
from memmlp.runs.run import Run

NOW = 1e9  # monotonic seconds by which every pause is over


class At:
    """A desk with its answers."""

    def __init__(self, folder: Path, server: Server | None = None):
        self.said: list[dict[str, str]] = []
        self.logger = FakeLogger(server)
        self.server = self.logger.server
        self.desk = Desk(self.logger, folder / "ledgers", self.said.append)

    def take(self, event: str, run: Run) -> None:
        self.desk.take({"event": event, "folder": str(run.folder)})

    @property
    def events(self) -> list[str]:
        return [one["event"] for one in self.said]


@pytest.fixture
def at(tmp_path: Path) -> At:
    return At(tmp_path)


def test_a_run_is_shown_while_it_goes_on(at: At, tmp_path: Path):
    run = a_run(tmp_path)
    at.take("begin", run)
    at.desk.look(NOW)
    assert (at.server.status[run.id], at.server.values[run.id]) == ("running", losses(3))
    run.log(4, {"loss": 1 / 4})
    at.desk.look(NOW)
    assert at.server.values[run.id] == losses(4)
    run.finish([])
    at.take("end", run)
    at.desk.look(NOW)
    assert (at.server.status[run.id], at.events) == ("done", ["shown"])
    assert at.server.begun == 1
    assert at.desk.runs == {}


def test_a_failed_run_is_shown_as_failed(at: At, tmp_path: Path):
    run = a_run(tmp_path)
    at.take("begin", run)
    at.desk.look(NOW)
    run.fail("loss is nan")
    at.take("end", run)
    at.desk.look(NOW)
    assert at.server.status[run.id] == "failed"


def test_a_server_that_is_killed_and_restarted_has_everything_once(at: At, tmp_path: Path):
    run = a_run(tmp_path)
    at.take("begin", run)
    at.desk.look(NOW)
    at.server.down = True
    for step in (4, 5):
        run.log(step, {"loss": 1 / step})
        at.desk.look(NOW * step)
    assert at.server.values[run.id] == losses(3)
    assert at.events == ["trouble"]
    at.server.down = False
    at.desk.look(NOW * 6)
    assert at.server.values[run.id] == losses(5)
    run.finish([])
    at.take("end", run)
    at.desk.look(NOW * 7)
    assert (at.server.status[run.id], at.server.values[run.id]) == ("done", losses(5))


def test_values_whose_receipt_was_lost_are_there_once(at: At, tmp_path: Path):
    run = a_run(tmp_path)
    at.take("begin", run)
    at.desk.look(NOW)
    run.log(4, {"loss": 1 / 4})
    at.server.drops = True
    at.desk.look(NOW)
    at.desk.look(2 * NOW)
    assert at.server.values[run.id] == losses(4)
    assert at.server.begun == 2


def test_pauses_grow_while_a_server_is_down(at: At, tmp_path: Path):
    run = a_run(tmp_path)
    at.server.down = True
    at.take("begin", run)
    pauses, now = [], 0.0
    for _ in range(8):
        at.desk.look(now)
        one = at.desk.runs[str(run.folder)]
        pauses.append(one.next - now)
        now = one.next
    assert pauses == [2, 4, 8, 16, 32, 60, 60, 60]


def test_a_logger_that_stays_down_is_given_up_with_a_reason(at: At, tmp_path: Path):
    run = a_run(tmp_path)
    at.server.down = True
    at.take("begin", run)
    at.desk.look(NOW)
    at.take("end", run)
    at.desk.look(at.desk.runs[str(run.folder)].ended or 0)
    assert at.events == ["trouble"]
    at.desk.look(NOW)
    assert at.events == ["trouble", "missed"]
    assert at.said[-1]["reason"] == "connection refused"
    at.server.down = False
    at.take("begin", run)
    at.desk.look(NOW)
    assert at.server.values[run.id] == losses(3), "its lock was left"


def test_a_run_that_another_process_shows_is_waited_for(at: At, tmp_path: Path):
    run = a_run(tmp_path)
    other = Session(FakeLogger(), run, tmp_path / "ledgers")
    at.take("begin", run)
    at.desk.look(NOW)
    assert at.server.status == {}
    other.leave()
    at.desk.look(2 * NOW)
    assert at.server.status == {run.id: "running"}
    assert at.events == []


def test_a_run_that_never_began_is_not_shown(at: At, tmp_path: Path):
    run = Run.of(tmp_path, "1" * 16)
    at.take("begin", run)
    at.desk.look(NOW)
    at.take("end", run)
    at.desk.look(NOW)
    assert (at.server.status, at.events) == ({}, ["shown"])


def test_a_run_that_begins_again_is_shown_from_its_beginning(at: At, tmp_path: Path):
    run = a_run(tmp_path)
    at.take("begin", run)
    at.desk.look(NOW)
    run.reset()
    again = a_run(tmp_path, steps=1)
    at.take("begin", again)
    at.desk.look(NOW)
    assert at.server.values[run.id] == losses(1)


def test_a_full_inbox_drops_and_counts(at: At, monkeypatch: pytest.MonkeyPatch):
    for _ in range(follower.INBOX + 3):
        at.desk.put({"event": "begin", "folder": "somewhere"})
    assert at.desk.dropped == 3
    assert at.desk.inbox.qsize() == follower.INBOX


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(follower, "PACE", 0.001)
    monkeypatch.setattr(follower, "SAMPLE", 0.0)


def told(*events: dict[str, str]) -> queue.Queue[Any]:
    found: queue.Queue[Any] = queue.Queue()
    for event in (*events, {"event": "stop"}):
        found.put(event)
    return found


@pytest.mark.usefixtures("quick")
def test_a_process_that_is_gone_ends_what_it_began(tmp_path: Path):
    run, server, said = a_run(tmp_path), Server(), []
    follow(
        [FakeLogger(server)], tmp_path, 0, told({"event": "begin", "folder": str(run.folder)}), said.append
    )
    assert (server.status, server.values[run.id]) == ({run.id: "killed"}, losses(3))
    assert [one["event"] for one in said] == ["shown"]


class Hung(FakeLogger):
    """A logger that never comes back from a run's beginning."""

    name = "hung"

    def __init__(self) -> None:
        super().__init__()
        self.gate: queue.Queue[Any] = queue.Queue()

    def begin(self, *_: Any) -> Any:
        """Wait until the test is over."""
        return self.gate.get()


@pytest.mark.usefixtures("quick")
def test_a_logger_that_hangs_holds_up_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(follower, "GRACE", 0.2)
    run, said, hung = a_run(tmp_path), [], Hung()
    events = [{"event": word, "folder": str(run.folder)} for word in ("begin", "end")]
    follow([hung, FakeLogger()], tmp_path, 0, told(*events), said.append)
    hung.gate.put(None)
    assert [(one["event"], one["logger"]) for one in said] == [("shown", "fake")]


@pytest.mark.usefixtures("quick")
def test_events_that_were_dropped_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(follower, "GRACE", 0.1)
    monkeypatch.setattr(follower, "INBOX", 1)
    run, said, hung = a_run(tmp_path), [], Hung()
    events = [{"event": word, "folder": str(run.folder)} for word in ("begin", "end", "begin", "end")]
    follow([hung], tmp_path, 0, told(*events), said.append)
    hung.gate.put(None)
    assert [one["event"] for one in said] == ["dropped"]
    assert int(said[0]["reason"]) >= 3


def test_the_machine_is_measured_into_the_run_and_goes_on_counting(tmp_path: Path):
    pytest.importorskip("psutil")
    run = a_run(tmp_path)
    for _ in range(2):
        sampler = MachineLog(1)
        sampler.take({"event": "begin", "folder": str(run.folder)})
        sampler.sample()
        sampler.take({"event": "end", "folder": str(run.folder)})
        sampler.sample()
    entries = MetricsLog(run.folder / SYSTEM).read()
    assert [(entry.phase, entry.step) for entry in entries] == [("system", 0), ("system", 1)]
    assert {"cpu_percent", "memory_mb"} <= set(entries[0].values)


def test_a_run_whose_folder_is_gone_is_not_made_again_by_a_measurement(tmp_path: Path):
    sampler = MachineLog(1)
    sampler.take({"event": "begin", "folder": str(tmp_path / "gone")})
    sampler.sample()
    assert not (tmp_path / "gone").exists()


def test_a_sweep_is_shown_and_its_failure_told(at: At, tmp_path: Path):
    names = {"name": "mine", "status": "done", "labels": {}, "aggregates": {}, "verdicts": {}}
    write_json(tmp_path / "summary.json", names)
    event = {"event": "sweep", "folder": str(tmp_path)}
    at.desk.take(event)
    at.server.down = True
    at.desk.take(event)
    assert (at.server.sweeps, at.events) == ([tmp_path.name], ["shown", "missed"])
