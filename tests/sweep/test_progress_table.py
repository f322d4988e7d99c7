"""The board of a sweep."""

import io
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from memmlp.sweep import progress_table
from memmlp.sweep.plan import Entry, Plan, RunTask
from memmlp.sweep.progress_table import QUIET, Board, describe_progress


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    tasks = tuple(RunTask(str(number) * 16, "memmlp", {"optim": {"steps": 9}}) for number in range(4))
    made = Plan("trial", tmp_path, tuple(Entry("variant", n, t.id) for n, t in enumerate(tasks)), tasks)
    for task in tasks:
        made.get_run(task).folder.mkdir(parents=True)
        made.get_run(task).write_manifest({"steps": 9})
    return made


def test_a_log_is_not_silent_while_runs_go_on(plan: Plan, monkeypatch: pytest.MonkeyPatch):
    clock = SimpleNamespace(monotonic=lambda: clock.now, time=lambda: 1.0, now=100.0)
    monkeypatch.setattr(progress_table, "time", clock)
    board, said = Board(), io.StringIO()
    board.console = Console(file=said, width=200)
    keys = [task.key for task in plan.tasks]

    def told(*states: str) -> list[str]:
        said.seek(0)
        said.truncate()
        board.update(plan, dict(zip(keys, states, strict=True)))
        return said.getvalue().splitlines()

    assert told("new", "new", "new", "done") == ["1 of 4 done; workers are starting"]
    assert told("new", "new", "new", "done") == []
    clock.now += QUIET - 1
    assert told("running", "new", "new", "done") == ["1 of 4 done; variant seed 0: running"]
    clock.now += QUIET - 1
    assert told("running", "new", "new", "done") == []
    plan.get_run(plan.tasks[0]).log(3, {"loss": 0.5})
    clock.now += 1
    assert told("running", "new", "new", "done") == ["1 of 4 done; variant seed 0: 3/9 loss 0.5"]
    assert told("running", "new", "new", "done") == []


def test_a_run_whose_training_is_over_shows_its_stage(plan: Plan):
    run = plan.get_run(plan.tasks[0])
    with run.lock():
        assert describe_progress(run) == "starting"
        run.attempt("deployment")
        assert describe_progress(run) == "exporting"
