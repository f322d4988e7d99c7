"""What may go and what stays."""

from __future__ import annotations

from pathlib import Path

import pytest

from memmlp.common.files import write_json
from memmlp.runs.notes import add_tags
from memmlp.runs.run import Run
from memmlp.runs.unneeded import delete, garbage

FAILED, OLD, GONE, CODES, USED, GOOD, EMPTY = (f"{letter}" * 16 for letter in "0123456")


def made(outputs: Path, name: str, kind: str = "memmlp", upstream: str | None = None, recipe: int = 1) -> Run:
    run = Run.of(outputs, name)
    run.begin(kind, {}, data="d", upstream=upstream, recipes={"metrics": recipe})
    run.model.write_bytes(b"weights")
    run.finish([run.model.name])
    return run


@pytest.fixture
def outputs(tmp_path: Path) -> Path:
    """One run of each sort."""
    made(tmp_path, FAILED).fail("loss is nan")
    made(tmp_path, OLD, recipe=0)
    made(tmp_path, GONE)
    made(tmp_path, CODES, "vqvae")
    made(tmp_path, USED, "vqvae", recipe=0)
    made(tmp_path, GOOD, upstream=USED)
    Run.of(tmp_path, EMPTY).folder.mkdir()
    sweep = tmp_path / "sweeps" / "mine"
    sweep.mkdir(parents=True)
    write_json(sweep / "plan.json", {"tasks": [{"id": GOOD}]})
    write_json(sweep / "entries.json", {"entries": [{"id": GONE}, {"id": GOOD}]})
    return tmp_path


def found(outputs: Path, *kinds: str) -> dict[str, str]:
    return {one.run.id: one.kind for one in garbage(outputs, *([kinds] if kinds else []))}


def test_failed_old_and_orphaned_runs_may_go(outputs: Path):
    assert found(outputs) == {
        FAILED: "failed", OLD: "old", GONE: "orphaned", CODES: "orphaned", EMPTY: "orphaned",
    }  # fmt: skip
    assert found(outputs, "failed") == {FAILED: "failed"}


def test_what_people_marked_or_somebody_is_at_or_a_run_builds_upon_stays(outputs: Path):
    add_tags(Run.of(outputs, FAILED), ["keep"])
    with Run.of(outputs, OLD).lock():
        assert {FAILED, OLD, USED} & set(found(outputs)) == set()


def test_deleted_is_the_folder_and_no_other(outputs: Path):
    before = {path.name for path in (outputs / "runs").iterdir()}
    (one,) = garbage(outputs, ["failed"])
    assert one.size > 0
    assert delete(one)
    assert {path.name for path in (outputs / "runs").iterdir()} == before - {FAILED}


def test_a_run_that_was_marked_meanwhile_stays(outputs: Path):
    (one,) = garbage(outputs, ["failed"])
    add_tags(one.run, ["keep"])
    assert not delete(one)
    assert one.run.folder.exists()


def test_a_damaged_plan_spares_nothing_and_stops_nothing(outputs: Path):
    (outputs / "sweeps" / "mine" / "plan.json").write_text("{")
    assert GOOD in found(outputs)
