"""`memmlp train`: what its jobs leave to each other."""

import pytest
import torch
from omegaconf import DictConfig

from memmlp.cli.train import train
from memmlp.common.errors import InputError


def test_a_failure_in_a_process_of_a_launcher_is_not_lost(monkeypatch: pytest.MonkeyPatch):
    """Launchers such as joblib's run jobs in other processes, whose lists of failures nobody sees."""

    def job(cfg: DictConfig) -> None:
        monkeypatch.setattr("os.getpid", lambda: -1)
        raise InputError(f"seed {cfg.seed} fails")

    with pytest.raises(InputError, match="seed 3 fails"):
        train(["-m", "seed=3,4"], job)


def test_threads_that_one_job_asks_for_are_not_those_of_the_next(monkeypatch: pytest.MonkeyPatch):
    before, used = torch.get_num_threads(), []
    monkeypatch.setattr("memmlp.config.build.build_experiment", lambda cfg: cfg)
    monkeypatch.setattr(
        "memmlp.training.run_stages.run_in_processes", lambda _: used.append(torch.get_num_threads())
    )
    try:
        train(["-m", f"threads=0,{before + 1},0"])
    finally:
        torch.set_num_threads(before)
    assert used == [before, before + 1, before]
