"""The board of a search."""

import io
from pathlib import Path

from fake_search import director, finish, open_study
from rich.console import Console

from memmlp.sweep.search.progress_table import SearchBoard


def test_a_log_has_the_running_trials_and_how_others_ended(tmp_path: Path):
    study = open_study(tmp_path)
    one, board, text = director(study, tmp_path), SearchBoard(tmp_path), io.StringIO()
    board.console = Console(file=text, width=200)
    plan = one.update(1)
    run = plan.get_run(plan.tasks[0])
    run.begin("memmlp", plan.tasks[0].config, data="d", prerequisite=None)
    with run.lock():
        board.update(study)
    assert text.getvalue().startswith("0 of 6; trial 0: starting")
    finish(plan)
    one.update(1)
    board.update(study)
    assert text.getvalue().splitlines()[-1].startswith("1 of 6; trial 0 complete: ")
