"""`memmlp train`: its jobs, and what they leave to each other."""

from pathlib import Path

import pytest
import torch
from conftest import Memmlp
from omegaconf import DictConfig

from memmlp.cli.train import train
from memmlp.common.errors import InputError


@pytest.fixture
def jobs(monkeypatch: pytest.MonkeyPatch) -> list[DictConfig]:
    seen: list[DictConfig] = []
    monkeypatch.setattr("memmlp.cli.train.run_training", seen.append)
    return seen


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


def test_train_gives_the_job_its_config(memmlp: Memmlp, jobs: list[DictConfig], tmp_path: Path):
    ran = memmlp("train", "profile=tiny", "memory=none", "seed=3")
    assert (ran.code, ran.out, ran.err) == (0, "", "")
    (cfg,) = jobs
    assert (cfg.seed, cfg.model.width, cfg.memory.name) == (3, 16, "none")
    assert "hydra" not in cfg
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [["seed=0,1", "-m"], pytest.param(["hydra.mode=MULTIRUN", "seed=0,1"], marks=pytest.mark.long)],
)
def test_a_multirun(memmlp: Memmlp, jobs: list[DictConfig], tmp_path: Path, arguments: list[str]):
    assert (memmlp("train", *arguments).code, [cfg.seed for cfg in jobs]) == (0, [0, 1])
    assert {path.name for path in tmp_path.rglob("*")} <= {"outputs", "multirun", "multirun.yaml"}


def test_jobs_that_would_save_predictions_in_one_folder_are_refused(memmlp: Memmlp, jobs: list[DictConfig]):
    ran = memmlp("train", "-m", "seed=0,1", "save_predictions=there")
    assert ran.code == 2
    assert ran.err.startswith("memmlp: save_predictions=there: 2 jobs")
    assert jobs == []
    assert memmlp("train", "-m", "seed=0,1", "save_predictions=there/${seed}").code == 0
    assert [cfg.save_predictions for cfg in jobs] == ["there/0", "there/1"]


@pytest.mark.slow
def test_a_failed_job_does_not_stop_the_others(memmlp: Memmlp, monkeypatch: pytest.MonkeyPatch):
    seeds = []

    def job(cfg: DictConfig) -> None:
        seeds.append(cfg.seed)
        if cfg.seed < 2:
            raise InputError(f"seed {cfg.seed} is bad")

    monkeypatch.setattr("memmlp.cli.train.run_training", job)
    ran = memmlp("train", "-m", "seed=0,1,2")
    assert (seeds, ran.code) == ([0, 1, 2], 2)
    assert ran.err.splitlines() == ["memmlp: seed 0 is bad", "memmlp: seed 1 is bad"]
