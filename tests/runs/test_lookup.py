"""Runs are found by their ids and compared."""

from __future__ import annotations

from pathlib import Path

import pytest
from begun_runs import CONFIG, begun
from fake_runs import fake_run

from memmlp.common.errors import InputError
from memmlp.runs.lookup import (
    Notes,
    add_tags,
    count_training_frames,
    find_run,
    get_notes_path,
    list_runs,
    read_notes,
    remove_tags,
    set_note,
)
from memmlp.runs.run import Run


def test_runs_are_found_by_the_beginning_of_their_id(tmp_path: Path):
    runs = [begun(tmp_path, CONFIG | {"seed": seed}) for seed in range(20)]
    (tmp_path / "runs" / "notes").mkdir()
    assert {run.id for run in list_runs(tmp_path)} == {run.id for run in runs}
    assert find_run(tmp_path, runs[3].id).folder == runs[3].folder
    assert find_run(tmp_path, runs[3].id[:12]).id == runs[3].id
    assert find_run("elsewhere", str(runs[3].folder)).id == runs[3].id


def test_the_newest_run_is_first(tmp_path: Path):
    for seed in range(3):
        begun(tmp_path, CONFIG | {"seed": seed}).write_manifest({"started": f"202{seed}"})
    assert [run.manifest["started"] for run in list_runs(tmp_path)] == ["2022", "2021", "2020"]


def test_no_such_run_is_one_line(tmp_path: Path):
    begun(tmp_path)
    for name in ("zz", "", "no/such"):
        with pytest.raises(InputError, match=f"run '{name}'"):
            find_run(tmp_path, name)


def test_a_bare_folder_name_is_found_and_an_ambiguous_beginning_lists_the_runs(tmp_path: Path, monkeypatch):
    runs = [Run.from_id(tmp_path, "ab" + digit * 14) for digit in "01"]
    for run in runs:
        run.begin("memmlp", {}, data="d", prerequisite=None)
    with pytest.raises(InputError, match=r"2 run ids .*: ab0+, ab1+"):
        find_run(tmp_path, "ab")
    monkeypatch.chdir(runs[0].folder.parent)
    assert find_run("outputs", runs[0].id).folder == runs[0].folder.resolve()


SEEN = {"optim": {"steps": 100, "batch": 8}, "model": {"frames": 11}}


def test_a_refiner_saw_its_network_s_frames_and_its_own_pieces(tmp_path: Path):
    network = fake_run(tmp_path, "network", config=SEEN)
    above = {"prerequisite": network.id}
    config = SEEN | {"refiner": {"frames": 20}}
    assert count_training_frames(fake_run(tmp_path, "refiner", config=config, origin=above)) == 100 * 8 * (
        11 + 20
    )


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
        get_notes_path(run).write_text(content)
        assert read_notes(run) == Notes()
