"""Tags and notes lie beside the run and change nothing of it."""

from __future__ import annotations

from pathlib import Path

import pytest
from begun_runs import begun

from memmlp.common.errors import InputError
from memmlp.runs.notes import Notes, add_tags, notes_path, read_notes, remove_tags, set_note


def test_tags_and_note_are_kept_and_survive_a_reset(tmp_path: Path):
    run = begun(tmp_path)
    assert read_notes(run) == Notes()
    add_tags(run, ["good", "a/b"])
    set_note(run, " a note ")
    add_tags(run, ["good"])
    run.reset()
    assert read_notes(run) == Notes(("a/b", "good"), "a note")
    assert remove_tags(run, ["good"]) == Notes(("a/b",), "a note")
    assert set_note(run, "") == Notes(("a/b",), "")


def test_bad_tags_and_notes_are_refused(tmp_path: Path):
    run = begun(tmp_path)
    for tag in ("", "two words", "x" * 65, "a,b", "a\nb"):
        with pytest.raises(InputError, match="must be up to 64"):
            add_tags(run, ["good", tag])
    assert read_notes(run) == Notes()
    with pytest.raises(InputError, match="tag 'good'"):
        remove_tags(run, ["good"])
    with pytest.raises(InputError, match="note: "):
        set_note(run, "x" * 10001)


def test_a_damaged_file_says_nothing(tmp_path: Path):
    run = begun(tmp_path)
    for content in ("", "[]", '{"tags": 5, "note": []}', '{"tags": [3], "note": null}'):
        notes_path(run).write_text(content)
        assert read_notes(run) == Notes()
