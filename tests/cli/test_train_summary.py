"""What `memmlp train` says of a network's size and times."""

from pathlib import Path

import pytest
from fake_runs import fake_run

from memmlp.cli.train_summary import show
from memmlp.training.request import Outcome


@pytest.mark.parametrize(("steps", "told"), [(2000, False), (20, True)])
def test_a_network_that_hardly_saw_motion_says_so(tmp_path: Path, capsys, steps: int, told: bool):
    config = {"optim": {"steps": steps, "batch": 8}, "model": {"frames": 11}}
    run = fake_run(tmp_path / "[old]", "a", config=config)
    show(Outcome(run, (), {}, ()))
    said = capsys.readouterr().out
    assert ("hardly trained" in said) == told
    assert f"run      {run.folder}\n" in said
    assert "picture" not in said  # which the run has not
