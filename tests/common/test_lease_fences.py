"""Who lost a folder publishes nothing below it, by whatever way it writes."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from begun_runs import complete

from memmlp.common.errors import LeaseLost
from memmlp.common.files import atomic_write, write_json
from memmlp.common.lease_fences import fenced, publish, remove_unfinished, temporary
from memmlp.runs.evaluation_file import write_report
from memmlp.runs.run import Run


class Lost:
    """The fence of a folder that has another owner."""

    number = 3

    def check(self) -> None:
        raise LeaseLost("lost")


WAYS: dict[str, Callable[[Run], object]] = {
    "checkpoint": lambda run: atomic_write(run.checkpoint, b"late"),
    "DONE": lambda run: run.finish(["model.safetensors"]),
    "manifest": lambda run: run.write_manifest({"late": True}),
    "begin": lambda run: run.begin("memmlp", {}, data="d", upstream=None),
    "FAILED": lambda run: run.fail("late"),
    "retry": Run.retry,
    "evaluation": lambda run: write_report(run.evaluation("late-0"), {"mean": {}}),
    "deployment": lambda run: run.deployment("int8-0").finish({"late": True}),
    "log": lambda run: run.log(9, {"loss": 9.0}),
    "picture": lambda run: publish(run.model, run.picture),
    "reset": Run.reset,
    "clear_stages": Run.clear_stages,
}


@pytest.mark.parametrize("way", WAYS)
def test_nothing_of_a_run_changes(tmp_path: Path, way: str):
    run = complete(tmp_path)
    before = {path: path.is_file() and path.read_bytes() for path in run.folder.rglob("*")}
    with fenced(run.folder, Lost()), pytest.raises(LeaseLost):
        WAYS[way](Run(run.folder))
    assert {path: path.is_file() and path.read_bytes() for path in run.folder.rglob("*")} == before


def test_folders_beside_it_are_free(tmp_path: Path):
    (tmp_path / "mine").mkdir()
    with fenced(tmp_path / "mine", Lost()):
        write_json(tmp_path / "mine too.json", {})
        with pytest.raises(LeaseLost):
            write_json(tmp_path / "mine" / "a.json", {})
    write_json(tmp_path / "mine" / "a.json", {})


def test_a_folder_is_the_same_by_its_other_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "mine").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    with fenced(Path("mine"), Lost()):
        for path in (tmp_path / "link" / "a", Path("link/a"), Path("other/../mine/a")):
            assert ".lease-3." in temporary(path).name
            with pytest.raises(LeaseLost):
                publish(tmp_path / "none", path)


def test_only_what_earlier_owners_left_unfinished_is_removed(tmp_path: Path):
    folder = tmp_path / "run"
    (folder / "evaluations").mkdir(parents=True)
    with fenced(folder, Lost()):
        of_three = [temporary(folder / "evaluations" / "a"), temporary(folder / "DONE"), temporary(folder)]
    others = [temporary(folder / "notes"), folder / ".mine.tmp", folder / ".lease-3"]
    for path in (*of_three, *others):
        path.touch()
    remove_unfinished(folder, 3)
    assert all(path.exists() for path in (*of_three, *others))
    remove_unfinished(folder, 4)
    assert not any(path.exists() for path in of_three)
    assert all(path.exists() for path in others)


def test_a_line_that_is_written_late_goes_with_the_log_that_it_was_written_to(tmp_path: Path):
    """The process is frozen between check and write, and the run's next owner begins meanwhile."""
    run = complete(tmp_path)
    run.log(1, {"loss": 1.0})

    class Frozen:
        number, checks = 3, 0

        def check(self) -> None:
            self.checks += 1
            if self.checks == 2:  # the log is open
                Run(run.folder).log(1, {"loss": 0.5})

    with fenced(run.folder, Frozen()):
        run.log(2, {"loss": 2.0})
    assert [entry.values for entry in run.metrics()] == [{"loss": 0.5}]


def test_a_line_that_is_half_written_is_an_error_and_then_gone(tmp_path: Path, monkeypatch):
    run = complete(tmp_path)
    run.log(1, {"loss": 1.0})
    with monkeypatch.context() as full:
        real = open

        class Short:
            def __init__(self, file):
                self.file = file

            def write(self, line: bytes) -> int:
                return self.file.write(line[:9])

            def __enter__(self):
                return self

            def __exit__(self, *_):
                self.file.close()

        full.setattr("builtins.open", lambda path, mode, **options: Short(real(path, mode, **options)))
        with pytest.raises(OSError, match=os.strerror(errno.ENOSPC)):
            run.log(2, {"loss": 2.0})
    run.log(3, {"loss": 3.0})
    assert [entry.step for entry in run.metrics()] == [1, 3]
