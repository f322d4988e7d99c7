"""Full or read-only disks, and files cut anywhere: nothing is lost, and one line names the fault."""

import builtins
import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import pytest
from begun_runs import complete
from conftest import Memmlp, one_line
from fake_runs import fake_run
from processes import until

from memmlp.common import lease
from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write
from memmlp.report.tables.measured_run import load_measured_run
from memmlp.runs.evaluation_file import is_intact, write_report
from memmlp.runs.run import Run
from memmlp.sweep.plan import Entry, Plan, RunTask
from memmlp.sweep.search.director import read_objectives
from memmlp.sweep.search.search_file import Objective
from memmlp.sweep.worker import try_task

TASK = RunTask("a" * 16, "memmlp", {}, None, ("stream-0", "fp32-0"))
STEPS = 2


class Disk:
    """The disk below a folder: it counts writes, and refuses them with an error from number `full` on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path, code: int, full: int):
        self.folder, self.code, self.full, self.writes = str(folder), code, full, 0
        for name in ("open", "mkdir"):
            monkeypatch.setattr(os, name, self._os(getattr(os, name)))
        real = builtins.open

        def opened(path: Any, mode: str = "r", *arguments: Any, **options: Any) -> Any:
            if not set(mode) & set("wax+") or not self._has(path):
                return real(path, mode, *arguments, **options)
            self.write(path)
            return Written(self, path, real(path, mode, *arguments, **options))

        monkeypatch.setattr(builtins, "open", opened)

    def _has(self, path: Any) -> bool:
        return isinstance(path, str | os.PathLike) and os.path.abspath(path).startswith(self.folder)

    def _os(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return os.mkdir or os.open, which writes if it creates."""

        def called(path: Any, flags: int = os.O_CREAT, *arguments: Any, **options: Any) -> Any:
            if flags & os.O_CREAT and self._has(path) and not os.path.exists(path):
                self.write(path)
            return call(path, flags, *arguments, **options)

        return called

    def write(self, path: Any) -> None:
        if self.writes >= self.full:
            raise OSError(self.code, os.strerror(self.code), str(path))
        self.writes += 1


class Written:
    """A file being written to a disk, which writes half of refused content."""

    def __init__(self, disk: Disk, path: Any, file: Any):
        self.disk, self.path, self.file = disk, path, file

    def write(self, content: Any) -> int:
        """Write, or write half and raise; an unbuffered file returns the length of its half."""
        try:
            self.disk.write(self.path)
        except OSError:
            half = self.file.write(content[: len(content) // 2])
            if hasattr(self.file, "raw") or not half:
                raise
            return half
        return self.file.write(content)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)


def finish(plan: Plan, task: RunTask) -> None:
    """Finish a run of a few steps as the pipeline does: from its checkpoint, and only missing stages."""
    run = plan.get_run(task)
    if not run.done:
        run.begin(task.kind, {"optim": {"steps": STEPS}}, data="d", prerequisite=None)
        run.clear_stages()
        first = int(run.checkpoint.read_bytes()) if run.checkpoint.exists() else 0
        for step in range(first + 1, STEPS + 1):
            run.log(step, {"loss": 1 / step})
            atomic_write(run.checkpoint, str(step))
        atomic_write(run.model, "weights")
        run.finish(["model.safetensors"])
    if not run.has("stream-0"):
        run.attempt("evaluation")
        report = {"mode": "stream", "run": run.id, "name": "stream-0", "settings": {}, "clips": []}
        write_report(run.evaluation("stream-0"), report | {"mean": {"rotation": {"MPJPE": 6.5}}})
    place = run.deployment("fp32-0")
    if not place.done:
        run.attempt("deployment")
        place.folder.mkdir(parents=True, exist_ok=True)
        atomic_write(place.onnx, "graph")
        place.finish({"run": run.id})


def sound(run: Run) -> bool:
    assert [entry.values for entry in run.metrics()] == [{"loss": 1 / (n + 1)} for n in range(run.step)]
    assert not run.done or run.verify() == []
    assert all(map(is_intact, run.evaluations.glob("*.json")))
    return not list(run.folder.rglob(".*.tmp"))


def error_of(action: Callable[[], object]) -> Exception | None:
    try:
        action()
    except Exception as error:
        return error
    return None


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("memmlp.runs.environment.read_code_files", lambda packages: {"a.py": b"0"})
    monkeypatch.setattr("memmlp.runs.run.create_code_patch", lambda: "")
    for module in ("run", "evaluation_file", "environment"):
        monkeypatch.setattr(f"memmlp.runs.{module}.describe_environment", lambda: {"host": "h"})


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    return Plan("trial", tmp_path, (Entry("arm", 0, TASK.id, TASK.stages),), (TASK,))


@pytest.mark.slow
def test_a_disk_that_is_full_at_any_write(plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(lease, "LEASE", 0.0)  # leases of processes that ended expire at once
    run = plan.get_run(TASK)
    full, refused = 0, True
    while refused:
        with monkeypatch.context() as context:
            disk = Disk(context, tmp_path, errno.ENOSPC, full)
            error = error_of(lambda: try_task(plan, TASK, finish))
        refused = error is not None
        if refused:
            assert isinstance(error, OSError)
            assert (error.errno, bool(error.filename)) == (errno.ENOSPC, True), full
            assert not plan.is_complete(TASK)
        assert sound(run), full
        assert run.failure is None
        until(lambda: try_task(plan, TASK, finish), "the run can be taken")
        assert plan.is_complete(TASK), full
        assert sound(run)
        assert run.step == STEPS
        run.reset()
        full += 1
    assert full == disk.writes + 1 > 30


@pytest.mark.slow
@pytest.mark.parametrize("words", [["train"], ["sweep", "14", "executor=debug"], ["tune"]])
def test_read_only_outputs_are_one_line(memmlp: Memmlp, tmp_path: Path, monkeypatch, words: list[str]):
    Disk(monkeypatch, tmp_path, errno.EROFS, 0)
    ran = memmlp(*words, "profile=tiny", "loggers=none")
    assert one_line(ran, "Read-only file system", "outputs"), ran.err
    assert not (tmp_path / "outputs").exists()


def at_every_byte(path: Path, look: Callable[[], object], whole_from: int = 1) -> int:
    """Cut a file at every byte, and look; return how often one line refused it. A file that lacks up to
    `whole_from` bytes, such as the last line feed, may pass for whole."""
    content, refused = path.read_bytes(), 0
    expected = look()
    for size in range(len(content)):
        path.write_bytes(content[:size])
        found: list[object] = []
        error = error_of(lambda found=found: found.append(look()))
        if error is None:
            assert found != [expected] or size >= len(content) - whole_from, size
        else:
            assert isinstance(error, InputError)
            assert path.name in str(error)
            refused += 1
    path.write_bytes(content)
    assert look() == expected
    return refused


@pytest.mark.slow
def test_records_of_a_run_cut_at_every_byte(tmp_path: Path):
    run = complete(tmp_path)
    assert at_every_byte(run.marker, lambda: run.status) == 0  # then it is not done
    for path in (run.evaluation("stream-0"), run.deployment("int8-0").latency):
        at_every_byte(path, lambda: (run.verify(), run.has("int8-0"), run.results))
    assert at_every_byte(run.manifest_path, lambda: (run.status, run.manifest)) == 0
    run.fail("no luck")
    assert at_every_byte(run.folder / "FAILED", lambda: run.failure) == 0
    at_every_byte(run.config_path, lambda: run.config, whole_from=len(run.config_path.read_bytes()))


@pytest.mark.slow
def test_results_plans_and_logs_cut_at_every_byte_are_refused(plan: Plan, tmp_path: Path):
    run = fake_run(tmp_path, "arm", clips=("salsa/01",), branches=("rotation",))
    path = run.evaluation("stream-0")
    size = path.stat().st_size
    assert at_every_byte(path, lambda: load_measured_run(run.folder).means) == size

    path = tmp_path / "plan.json"
    plan.save(path)
    size = path.stat().st_size
    assert at_every_byte(path, lambda: Plan.load(path)) >= size - 1

    # Without its last validation, an earlier one must not pass for a trial's result.
    run = complete(tmp_path, {"optim": {"steps": 20}})
    wanted = [Objective("MPJPE", ((1.0, "rotation MPJPE"),))]
    for step in (10, 20):
        run.log(step, {"rotation MPJPE": 100.0 / step}, "val")
    assert read_objectives(wanted, run) == [5.0]
    size = run.metrics_path.stat().st_size
    assert at_every_byte(run.metrics_path, lambda: read_objectives(wanted, run)) == size
