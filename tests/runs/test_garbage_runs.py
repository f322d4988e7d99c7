"""What may go and what stays."""

from pathlib import Path

import pytest

from memmlp.common.files import write_json
from memmlp.common.lease import current_process
from memmlp.runs.garbage_runs import delete_garbage, find_garbage
from memmlp.runs.lookup import add_tags, remove_tags
from memmlp.runs.run import Run

FAILED, OLD, GONE, CODES, USED, GOOD, EMPTY = (f"{letter}" * 16 for letter in "0123456")


def made(outputs, name: str, kind: str = "memmlp", prerequisite: str | None = None, version: int = 1) -> Run:
    run = Run.from_id(outputs, name)
    run.begin(kind, {}, data="d", prerequisite=prerequisite, component_versions={"metrics": version})
    run.model.write_bytes(b"weights")
    run.finish([run.model.name])
    return run


@pytest.fixture
def outputs(tmp_path: Path) -> Path:
    Run.from_id(tmp_path, FAILED).begin("memmlp", {}, data="d", prerequisite=None)
    Run.from_id(tmp_path, FAILED).fail("loss is nan")
    made(tmp_path, OLD, version=0)
    made(tmp_path, GONE)
    made(tmp_path, CODES, "vqvae")
    made(tmp_path, USED, "vqvae", version=0)
    made(tmp_path, GOOD, prerequisite=USED)
    Run.from_id(tmp_path, EMPTY).folder.mkdir()
    sweep = tmp_path / "sweeps" / "mine"
    sweep.mkdir(parents=True)
    now = {"label": "a", "seed": 0, "id": GOOD}
    write_json(sweep / "sweep.json", {"variants": [{"label": "a"}]})
    write_json(sweep / "plan.json", {"entries": [now], "tasks": [{"id": GOOD}]})
    write_json(sweep / "entries.json", {"entries": [{**now, "id": GONE}, now]})
    return tmp_path


def found(outputs: Path, *kinds: str) -> dict[str, str]:
    return {one.run.id: one.kind for one in find_garbage(outputs, *([kinds] if kinds else []))}


def test_failed_old_and_orphaned_runs_may_go(outputs: Path):
    assert found(outputs) == {FAILED: "failed", OLD: "old", CODES: "orphaned", EMPTY: "orphaned"}
    assert found(outputs, "failed") == {FAILED: "failed"}


def test_what_people_marked_or_somebody_is_at_or_a_run_builds_upon_stays(outputs: Path):
    add_tags(Run.from_id(outputs, FAILED), ["keep"])
    with Run.from_id(outputs, OLD).lock():
        assert {FAILED, OLD, USED} & set(found(outputs)) == set()


def test_deleted_is_the_folder_and_no_other_unless_it_was_marked_meanwhile(outputs: Path):
    before = {path.name for path in (outputs / "runs").iterdir()}
    (one,) = find_garbage(outputs, ["failed"])
    assert one.size > 0
    add_tags(one.run, ["keep"])
    assert not delete_garbage(one)
    assert {path.name for path in (outputs / "runs").iterdir()} == before
    remove_tags(one.run, ["keep"])
    assert delete_garbage(one)
    assert {path.name for path in (outputs / "runs").iterdir()} == before - {FAILED}


@pytest.mark.parametrize(("file", "content"), [
    ("plan.json", '{"entries": [], "tasks": []}'),  # its data is not there
    ("plan.json", '{"entries": [{"label": "a", "seed": 1, "id": "0"}]}'),  # for another seed
    ("entries.json", "{"),
    ("plan.json", '{"tasks": [5]}'),  # damaged
    ("plan.json", '{"tasks": null}'),
])  # fmt: skip
def test_a_plan_that_does_not_name_a_run_condemns_none(outputs: Path, file: str, content: str):
    (outputs / "sweeps" / "mine" / file).write_text(content)
    assert {GONE, GOOD} & set(found(outputs)) == set()


def test_a_trained_run_whose_export_failed_stays(outputs: Path):
    made(outputs, "7" * 16).fail("step.int8.onnx: ONNX Runtime differs")
    assert "7" * 16 not in found(outputs)
    Run.from_id(outputs, "8" * 16).begin("memmlp", {}, data="d", prerequisite=None)
    Run.from_id(outputs, "8" * 16).fail("loss is nan")
    assert found(outputs)["8" * 16] == "failed"


def test_prerequisites_of_kept_runs_are_kept(outputs: Path):
    made(outputs, "7" * 16, "vqvae", version=0)
    made(outputs, "8" * 16, prerequisite="7" * 16, version=0)
    made(outputs, "9" * 16, prerequisite="8" * 16)
    assert {"7" * 16, "8" * 16} & set(found(outputs)) == set()


def test_a_finished_vqvae_of_a_search_under_way_stays(outputs: Path):
    folder = outputs / "tune" / "mine" / "controllers"
    folder.mkdir(parents=True)
    write_json(folder / "one.json", {"entries": [], "tasks": [{"id": CODES}]})
    assert CODES in found(outputs)
    write_json(folder / "one.process", current_process())
    assert CODES not in found(outputs)
