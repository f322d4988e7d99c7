"""Workers do each run exactly once, whoever dies; the plans here need no training."""

import errno
import json
import os
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import pytest
from machines import Clock, apart
from processes import PATIENCE, started, until

from memmlp.common.errors import InputError, TrainingDiverged
from memmlp.common.lease import ChangeTimer
from memmlp.config import build, compose
from memmlp.config.build import make_readable_name
from memmlp.config.compose import compose_config
from memmlp.runs.lookup import change_run
from memmlp.runs.run import Run
from memmlp.sweep import worker
from memmlp.sweep.plan import Entry, Plan, RunTask, order_tasks
from memmlp.sweep.worker import Cancelled, has_controller, is_writer_alive, try_task, work_on_plan

CODES = RunTask("c" * 16, "vqvae", {})
ONE, TWO, ALONE = (
    RunTask(str(n) * 16, "memmlp", {}, above) for n, above in ((1, CODES.id), (2, CODES.id), (3, None))
)


def plan(outputs: Path, *tasks: RunTask, **changes) -> Plan:
    entries = tuple(Entry(f"variant {task.id[0]}", 0, task.id) for task in tasks if task.kind == "memmlp")
    return Plan("trial", outputs, entries, order_tasks(tasks), **changes)


def saved(outputs: Path, *tasks: RunTask, **changes) -> Path:
    path = outputs / "plan.json"
    plan(outputs, *tasks, **changes).save(path)
    return path


def finish(plan: Plan, task: RunTask) -> None:
    run = plan.get_run(task)
    run.begin(task.kind, {}, data="d", prerequisite=task.prerequisite)
    run.results_path.write_text("{}")
    run.finish(["results.json"])


def test_prerequisite_runs_come_first_and_each_task_once(tmp_path: Path):
    seen: list[str] = []

    def perform(plan: Plan, task: RunTask) -> None:
        assert task.prerequisite is None or Run.from_id(plan.outputs, task.prerequisite).done
        seen.append(task.id)
        finish(plan, task)

    for _ in range(2):
        change_run(Run.from_id(tmp_path, TWO.id), "prioritize")
        work_on_plan(saved(tmp_path, ALONE, CODES, ONE, TWO, ONE), perform)
    assert seen == [CODES.id, TWO.id, ALONE.id, ONE.id]


def test_a_failure_is_left_with_its_run_and_the_others_go_on(tmp_path: Path):
    errors = {
        ONE.id: InputError("a bad key"), TWO.id: TrainingDiverged("nan"), ALONE.id: ValueError("a\nbug"),
    }  # fmt: skip

    def perform(plan: Plan, task: RunTask) -> None:
        if task.id in errors:
            raise errors[task.id]
        finish(plan, task)

    path = saved(tmp_path, CODES, ONE, TWO, ALONE)
    work_on_plan(path, perform)
    now = Plan.load(path)
    assert now.read_states() == {CODES.id: "done"} | dict.fromkeys(errors, "failed")
    assert (now.get_run(ONE).failure, now.get_run(ALONE).failure) == ("a bad key", "ValueError: a bug")
    assert now.list_remaining() == []
    del errors[ONE.id]
    now.get_run(ONE).retry()
    work_on_plan(path, perform)
    assert now.read_states()[ONE.id] == "done"


def test_a_stopped_run_is_left_until_it_is_retried(tmp_path: Path):
    path, plan_run = saved(tmp_path, ALONE, CODES), Run.from_id(tmp_path, ALONE.id)

    def perform(plan: Plan, task: RunTask) -> None:
        if task == ALONE:
            plan_run.begin("memmlp", {}, data="d", prerequisite=None)
            change_run(plan_run, "stop")
        plan.get_run(task).check_not_stopped()
        finish(plan, task)

    work_on_plan(path, perform)
    plan = Plan.load(path)
    assert (plan.read_states()[ALONE.id], plan_run.failure, plan_run.fault) == (
        "stopped", None, "stopped on request"
    )  # fmt: skip
    work_on_plan(path, Mock(side_effect=AssertionError))
    change_run(plan_run, "retry")
    work_on_plan(path, finish)
    assert plan.read_states()[ALONE.id] == "done"
    log = (plan_run.folder / "actions.jsonl").read_text().splitlines()
    assert [json.loads(line)["action"] for line in log] == ["stop", "retry"]
    with pytest.raises(InputError, match="must be unfinished"):
        change_run(plan_run, "stop")


def test_what_needs_a_failed_run_is_blocked(tmp_path: Path):
    path = saved(tmp_path, CODES, ONE, ALONE)
    work_on_plan(path, Mock(side_effect=InputError("no")))
    assert Plan.load(path).read_states() == {CODES.id: "failed", ONE.id: "blocked", ALONE.id: "failed"}
    further = RunTask("f" * 16, "memmlp", {}, ONE.id)
    deeper = Plan.load(saved(tmp_path, CODES, ONE, further))
    assert deeper.read_states() == {CODES.id: "failed", ONE.id: "blocked", further.id: "blocked"}
    assert deeper.list_remaining() == []


def test_a_cancelled_run_is_left_as_it_is(tmp_path: Path):
    def perform(plan: Plan, task: RunTask) -> None:
        plan.get_run(task).begin("memmlp", {}, data="d", prerequisite=None)
        saved(tmp_path, ALONE, cancelled=(ALONE.id,))
        raise Cancelled

    path = saved(tmp_path, ALONE)
    work_on_plan(path, perform)
    assert Plan.load(path).get_run(ALONE).status == "interrupted"
    assert Plan.load(path).list_remaining() == []


@pytest.mark.parametrize("work", [compose_config, lambda words: make_readable_name("memmlp", {"seed": 0})])
def test_a_request_to_end_a_worker_is_no_config_error(tmp_path: Path, monkeypatch, work):
    """OmegaConf reports an interruption as an error of its own."""
    monkeypatch.setattr("omegaconf.listconfig.ListConfig._validate_set", Mock(side_effect=KeyboardInterrupt))
    for cached in (compose._compose_options, build._compose_default):
        cached.cache_clear()
    trial = plan(tmp_path, ALONE)
    with pytest.raises(KeyboardInterrupt):
        try_task(trial, ALONE, lambda plan, task: work(["profile=tiny"]))
    assert trial.get_run(ALONE).failure is None


def test_a_worker_stays_while_its_plan_is_open_and_wanted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(worker, "PAUSE", 0.01)
    path = saved(tmp_path, open=True)
    done: list[str] = []

    def perform(plan: Plan, task: RunTask) -> None:
        done.append(task.id)
        finish(plan, task)

    looks: list[Path] = []
    monkeypatch.setattr(Plan, "load", lambda path, load=Plan.load: (looks.append(path), load(path))[1])
    thread = threading.Thread(target=work_on_plan, args=(path, perform), daemon=True)
    thread.start()
    until(lambda: len(looks) > 2, "it looks again")
    assert thread.is_alive()
    saved(tmp_path, ALONE, open=True)
    until(lambda: done, "it takes up what was added")
    saved(tmp_path, ALONE)
    thread.join(PATIENCE)
    assert not thread.is_alive()
    assert done == [ALONE.id]
    work_on_plan(saved(tmp_path, ONE, open=True), perform, should_continue=lambda: False)
    assert done == [ALONE.id]


@pytest.mark.slow
def test_a_run_whose_process_died_is_lost_then_taken_over(tmp_path: Path):
    path = saved(tmp_path, ALONE)
    code = (
        "import sys, time; from pathlib import Path; from memmlp.sweep.worker import work_on_plan\n"
        "def perform(plan, task):\n"
        "    plan.get_run(task).begin('memmlp', {}, data='d', prerequisite=None)\n"
        "    print('at it', flush=True); time.sleep(600)\n"
        "work_on_plan(Path(sys.argv[1]), perform)"
    )
    with started([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE) as victim:
        victim.stdout.readline()
        assert Plan.load(path).read_states()[ALONE.id] == "running"
        assert not try_task(Plan.load(path), ALONE, finish)
        victim.kill()
        victim.wait()
    assert Plan.load(path).read_states()[ALONE.id] == "lost"
    work_on_plan(path, finish)
    run = Plan.load(path).get_run(ALONE)
    assert (run.status, len(run.manifest["attempts"])) == ("done", 2)


def test_a_run_that_kills_its_workers_fails_at_last(tmp_path: Path):
    path = saved(tmp_path, ALONE)
    run = Plan.load(path).get_run(ALONE)
    for _ in range(worker.MAX_DEATHS - 1):
        run.begin("memmlp", {}, data="d", prerequisite=None)
    assert worker.count_deaths(run) == worker.MAX_DEATHS - 1
    run.log(5, {"loss": 1.0})
    assert worker.count_deaths(run) == 0
    for _ in range(worker.MAX_DEATHS):
        run.begin("memmlp", {}, data="d", prerequisite=None)
    work_on_plan(path, finish)
    assert run.status == "failed"
    assert "processes in a row died at step 5" in str(run.failure)
    run.retry()
    assert worker.count_deaths(run) == 0
    work_on_plan(path, finish)
    assert run.status == "done"


@pytest.mark.parametrize("where", [lambda monkeypatch: None, apart])
def test_workers_do_each_task_once_where_locks_do_nothing(tmp_path: Path, monkeypatch, where: Callable):
    where(monkeypatch)
    monkeypatch.setattr(worker, "PAUSE", 0.001)
    tasks = [RunTask(f"{n:016x}", "memmlp", {}, CODES.id if n % 2 else None) for n in range(6)]
    path, seen = saved(tmp_path, CODES, *tasks), []

    def perform(plan: Plan, task: RunTask) -> None:
        seen.append(task.id)
        finish(plan, task)

    threads = [threading.Thread(target=work_on_plan, args=(path, perform)) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert Counter(seen) == Counter([CODES.id, *(task.id for task in tasks)])


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS])
def test_a_full_disk_is_no_runs_failure(tmp_path: Path, code: int):
    path = saved(tmp_path, ALONE)
    with pytest.raises(OSError, match=os.strerror(code)):
        work_on_plan(path, Mock(side_effect=OSError(code, os.strerror(code), "checkpoint.safetensors")))
    assert Plan.load(path).read_states() == {ALONE.id: "new"}
    work_on_plan(path, finish)
    assert Plan.load(path).read_states() == {ALONE.id: "done"}


def test_a_controller_elsewhere_is_dead_once_it_has_not_been_seen_for_long(tmp_path: Path, monkeypatch):
    """Whatever its machine's clock says."""
    clock = Clock()
    monkeypatch.setattr(worker, "_changes", ChangeTimer(clock))
    path = saved(tmp_path, open=True)
    for moment in (0.0, 2e9, 1e9):
        os.utime(path, (moment, moment))
        assert has_controller(path)
        clock.now += worker.ABANDONED - 1
        assert has_controller(path)
    clock.now += 1
    assert not has_controller(path)
    assert has_controller(saved(tmp_path))


def test_presence_ends_with_its_process(tmp_path: Path):
    path = tmp_path / "here.lock"
    code = (
        "import sys, time; from pathlib import Path; from memmlp.sweep.worker import write_process_file\n"
        "write_process_file(Path(sys.argv[1])); print('here', flush=True); time.sleep(600)"
    )
    with started([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        assert is_writer_alive(path)
        process.kill()
        process.wait()
    assert not is_writer_alive(path)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"entries": [{}], "tasks": [], "cancelled": []}'])
def test_a_plan_that_is_none_is_one_line(tmp_path: Path, text: str):
    (tmp_path / "plan.json").write_text(text)
    with pytest.raises(InputError, match=r"plan\.json: must be the plan of a sweep"):
        Plan.load(tmp_path / "plan.json")
