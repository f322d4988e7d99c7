"""Runs are found by their ids and compared."""

from pathlib import Path

import pytest
from begun_runs import CONFIG, begun

from memmlp.common.errors import InputError
from memmlp.runs import lookup


def test_runs_are_found_by_the_beginning_of_their_id(tmp_path: Path):
    runs = [begun(tmp_path, CONFIG | {"seed": seed}) for seed in range(10)]
    for seed, run in enumerate(runs):
        run.write_manifest({"started": f"202{seed}-01-01"})
    (tmp_path / "runs" / "notes").mkdir()
    assert [run.id for run in lookup.list_runs(tmp_path)] == [run.id for run in runs[::-1]]
    for outputs, name in (
        (tmp_path, runs[3].id), (tmp_path, runs[3].id[:12]), ("elsewhere", str(runs[3].folder)),
    ):  # fmt: skip
        assert lookup.find_run(outputs, name).folder == runs[3].folder


def test_no_such_run_is_one_line(tmp_path: Path):
    begun(tmp_path)
    for name in ("zz", "", "no/such"):
        with pytest.raises(InputError, match=f"run '{name}'"):
            lookup.find_run(tmp_path, name)


def test_tags_and_note_are_kept_and_survive_a_reset(tmp_path: Path):
    run = begun(tmp_path)
    assert lookup.read_notes(run) == lookup.Notes()
    lookup.add_tags(run, ["good", "a/b"])
    lookup.edit_notes(run, note=" a note ")
    lookup.add_tags(run, ["good"])
    run.reset()
    assert lookup.read_notes(run) == lookup.Notes(("a/b", "good"), "a note")
    assert lookup.remove_tags(run, ["good"]) == lookup.Notes(("a/b",), "a note")
    assert lookup.edit_notes(run, note="") == lookup.Notes(("a/b",), "")


def test_a_tag_from_elsewhere_does_not_stop_a_note(tmp_path: Path):
    run = begun(tmp_path)
    run.notes_path.write_text('{"tags": ["bad tag"], "note": ""}')
    assert lookup.edit_notes(run, note="hi") == lookup.Notes(("bad tag",), "hi")
    with pytest.raises(InputError, match="tag 'worse tag'"):
        lookup.add_tags(run, ["worse tag"])


def test_a_damaged_file_says_nothing(tmp_path: Path):
    run = begun(tmp_path)
    for content in ("", "[]", '{"tags": 5, "note": []}', '{"tags": [3], "note": null}'):
        run.notes_path.write_text(content)
        assert lookup.read_notes(run) == lookup.Notes()
