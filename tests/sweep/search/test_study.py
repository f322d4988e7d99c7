"""The study survives kills, proposes the same again, and says what it cannot read."""

import time
from pathlib import Path

import pytest
from fake_search import director, finish, open_study, search, to_the_end
from machines import fenced

from memmlp.common.errors import InputError, LeaseLost
from memmlp.sweep.search.study import Study, journal_path, repair_journal


def test_a_resumed_search_proposes_what_the_undisturbed_one_does(tmp_path: Path):
    for name in ("calm", "stopped"):
        (tmp_path / name).mkdir()
    calm = open_study(tmp_path / "calm")
    to_the_end(calm, tmp_path / "calm", capacity=1)
    for _ in range(6):
        one = director(open_study(tmp_path / "stopped"), tmp_path / "stopped")
        finish(one.update(1))
    last = open_study(tmp_path / "stopped")
    to_the_end(last, tmp_path / "stopped", capacity=1)
    assert [trial.params for trial in last.trials] == [trial.params for trial in calm.trials]


def test_a_grid_has_each_combination_once_in_order_however_often_it_is_stopped(tmp_path: Path):
    space = {"loss": {"rotation_all": {"choices": [1.0, 2.0]}, "hand": {"choices": [0.1, 0.2, 0.3]}}}
    grid = {"sampler": "grid", "space": space, "n_trials": 6, "startup": None, "prune_after": None}
    for _ in range(3):
        one = director(open_study(tmp_path, **grid), tmp_path)
        finish(one.update(1))
    study = open_study(tmp_path, **grid)
    to_the_end(study, tmp_path, capacity=1)
    every = [{"loss.rotation_all": a, "loss.hand": b} for a in (1.0, 2.0) for b in (0.1, 0.2, 0.3)]
    assert [trial.params for trial in study.trials] == every


def test_a_torn_line_and_a_dead_owners_lock_are_mended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """At once: Optuna alone sleeps until the lock is half a minute old."""

    def sleep(seconds: float) -> None:
        raise AssertionError("it waits for the lock")

    study = open_study(tmp_path)
    one = director(study, tmp_path)
    finish(one.update(2))
    one.update(2)
    with open(journal_path(tmp_path), "ab") as file:
        file.write(b'{"op_code":4,"worker_id":"x"')
    Path(f"{journal_path(tmp_path)}.lock").symlink_to(journal_path(tmp_path))
    monkeypatch.setattr(
        "memmlp.runs.run.create_code_patch", str
    )  # git, in a changed checkout, is waited for in sleeps
    monkeypatch.setattr(time, "sleep", sleep)
    to_the_end(open_study(tmp_path), tmp_path)
    again = open_study(tmp_path)
    assert [trial.number for trial in again.trials] == list(range(6))


class Superseded:
    """The fence of an owner of a search that another one follows before a check, or right after the first."""

    number = 1

    def __init__(self, path: Path, frozen_after: bool):
        self.path, self.lost, self.mending = path, not frozen_after, False

    def check(self) -> None:
        if self.mending:
            return  # that is the next owner, in this process
        if self.lost:
            raise LeaseLost("lost")
        self.lost = self.mending = True
        repair_journal(self.path)
        self.mending = False


@pytest.mark.parametrize("frozen_after", [False, True])
def test_an_owner_that_wakes_up_superseded_tells_the_study_nothing(tmp_path: Path, frozen_after: bool):
    study = open_study(tmp_path)
    before = journal_path(tmp_path).read_bytes()
    with (
        fenced(tmp_path, Superseded(journal_path(tmp_path), frozen_after)),
        pytest.raises((LeaseLost, KeyError)),
    ):
        study.ask()
    assert journal_path(tmp_path).read_bytes() == before
    assert open_study(tmp_path).trials == []


@pytest.mark.slow
def test_a_team_storage_and_a_bad_one(tmp_path: Path):
    study = open_study(tmp_path, storage=f"sqlite:///{tmp_path}/team.db")
    to_the_end(study, tmp_path)
    assert len(study.trials) == 6
    assert not journal_path(tmp_path).exists()
    with pytest.raises(InputError, match=r"search\.storage=nonsense:"):
        open_study(tmp_path, storage="nonsense://x")


@pytest.mark.parametrize(
    "content", [b"x" * 5000, b"hello\nthis is no journal\n", b'{"op_code":0,"x":1}\ngarbage\n{}\n']
)
def test_what_is_no_journal_is_left_alone_and_named(tmp_path: Path, content: bytes):
    journal_path(tmp_path).write_bytes(content)
    for look in (open_study, lambda folder: Study.view(search(), "mine", folder)):
        with pytest.raises(InputError, match=r"study.journal: must be an Optuna journal"):
            look(tmp_path)
    assert journal_path(tmp_path).read_bytes() == content
