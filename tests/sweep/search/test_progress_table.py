"""The board of a search says on which devices its runs are worked on."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from fake_search import director, finish, open_study
from rich.console import Console

from memmlp.sweep.search.progress_table import SearchBoard, describe_end, render

CARD = {"device": "cuda", "gpu": "A card", "gpu_index": "1"}


def drawn(study, folder: Path) -> str:
    console = Console(width=120)
    with console.capture() as said:
        console.print(render(study, folder))
    return said.get()


def first_lines(study, folder: Path) -> list[str]:
    board, said = SearchBoard(folder), io.StringIO()
    board.console = Console(file=said, width=200)
    board.update(study)
    return said.getvalue().splitlines()


def test_the_devices_of_runs_under_way_are_counted(tmp_path: Path):
    study = open_study(tmp_path)
    plan = director(study, tmp_path).update(3)
    assert "running on" not in drawn(study, tmp_path)
    runs = [plan.run_of(task) for task in plan.tasks]
    for run, task, facts in zip(runs, plan.tasks, (CARD, {"device": "cpu"}, CARD), strict=True):
        run.begin("memmlp", task.config, data="d", prerequisite=None)
        run.write_manifest(facts)
    with runs[0].lock(), runs[1].lock(), runs[2].lock():
        assert "running on GPU 1 (A card): 2, cpu: 1" in drawn(study, tmp_path)
        lines = first_lines(study, tmp_path)
        assert [text.partition(";")[2][:9] for text in lines] == [" trial 0:", " trial 1:", " trial 2:"]
    assert first_lines(study, tmp_path) == [f"0 of {study.search.n_trials}; workers are starting"]


@pytest.mark.parametrize(
    ("facts", "said"), [(CARD, "complete on GPU 1 (A card): "), ({"device": None}, "complete: ")]
)
def test_a_trial_that_ended_says_on_which_device(tmp_path: Path, facts: dict, said: str):
    study = open_study(tmp_path)
    one = director(study, tmp_path)
    plan = one.update(1)
    finish(plan)
    plan.run_of(plan.tasks[0]).write_manifest(facts)
    one.update(1)
    assert f"trial 0 {said}" in describe_end(study.trials[0], tmp_path)
