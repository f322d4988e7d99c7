"""A sync fills in what was missed, once."""

from __future__ import annotations

from pathlib import Path

from fake_logger import FakeLogger, a_run, losses

from memmlp.common.files import write_json
from memmlp.experiment_tracking.follower import ledgers
from memmlp.experiment_tracking.run_logger import Session
from memmlp.experiment_tracking.sync import sync, sync_sweeps
from memmlp.runs.notes import add_tags


def test_a_second_sync_shows_nothing_again(tmp_path: Path):
    logger, said = FakeLogger(), []
    runs = [a_run(tmp_path, "0" * 16), a_run(tmp_path, "1" * 16)]
    runs[0].finish([])
    runs[1].fail("why")
    assert sync(logger, runs, tmp_path, said.append) == {"shown": 2}
    assert sync(logger, runs, tmp_path, said.append) == {"same": 2}
    assert logger.server.status == {runs[0].id: "done", runs[1].id: "failed"}
    assert logger.server.values == {run.id: losses(3) for run in runs}
    assert (logger.server.begun, said) == (2, [])


def test_what_changed_is_shown_and_full_shows_everything(tmp_path: Path):
    logger, runs = FakeLogger(), [a_run(tmp_path, "0" * 16), a_run(tmp_path, "1" * 16)]
    sync(logger, runs, tmp_path, print)
    add_tags(runs[0], ["good"])
    assert sync(logger, runs, tmp_path, print) == {"shown": 1, "same": 1}
    assert sync(logger, runs, tmp_path, print, full=True) == {"shown": 2}
    assert logger.server.values == {run.id: losses(3) for run in runs}


def test_what_a_logger_lost_is_filled_in(tmp_path: Path):
    logger, run = FakeLogger(), a_run(tmp_path)
    sync(logger, [run], tmp_path, print)
    logger.server.status.clear()
    assert sync(logger, [run], tmp_path, print) == {"shown": 1}


def test_runs_that_go_on_are_left_to_their_follower(tmp_path: Path):
    logger, run, other = FakeLogger(), a_run(tmp_path, "0" * 16), a_run(tmp_path, "1" * 16)
    followed = Session(FakeLogger(), run, ledgers(tmp_path, logger))
    with other.lock():
        assert sync(logger, [run, other], tmp_path, print) == {"live": 2}
    followed.leave()
    assert sync(logger, [run, other], tmp_path, print) == {"shown": 2}


def test_one_run_that_fails_does_not_stop_the_others(tmp_path: Path):
    logger, said = FakeLogger(), []
    bad, good = a_run(tmp_path, "0" * 16), a_run(tmp_path, "1" * 16)
    bad.config_path.write_text("{")
    assert sync(logger, [bad, good], tmp_path, said.append) == {"failed": 1, "shown": 1}
    assert "cannot be read" in said[0]


SUMMARY = {"name": "mine", "status": "done", "labels": {}, "aggregates": {}, "verdicts": {}}


def test_a_sweep_file_with_two_command_lines_is_two_sweeps(tmp_path: Path):
    """Each has a folder; under the file's name the one was shown in the place of the other."""
    logger, folders = FakeLogger(), [tmp_path / "mine", tmp_path / "mine-9b8d1a20"]
    for folder in folders:
        folder.mkdir()
        write_json(folder / "summary.json", SUMMARY)
    assert sync_sweeps(logger, folders, print) == 2
    assert logger.server.sweeps == ["mine", "mine-9b8d1a20"]


def test_sweeps_that_left_a_summary_are_shown(tmp_path: Path):
    logger, said = FakeLogger(), []
    folders = [tmp_path / "mine", tmp_path / "other"]
    for folder in folders:
        folder.mkdir()
    write_json(folders[0] / "summary.json", SUMMARY)
    assert sync_sweeps(logger, folders, said.append) == 1
    logger.server.down = True
    assert sync_sweeps(logger, folders, said.append) == 0
    assert said == ["sweep mine is not shown by fake: connection refused"]
