"""Executors: submitit's local and debug modes, Slurm's by its sbatch file, Ray where it is installed."""

from __future__ import annotations

import contextlib
import importlib.util
import time
from functools import partial
from pathlib import Path

import pytest
from processes import ignoring_interrupts, until

from memmlp.common.errors import InputError
from memmlp.sweep import controller
from memmlp.sweep.board import Board
from memmlp.sweep.controller import PATIENCE, Fleet
from memmlp.sweep.executors import Ray, Requeued, Submitit, sbatch
from memmlp.sweep.plan import Plan, RunTask


def touch(path: str) -> None:
    Path(path).touch()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # its logs stay open
@pytest.mark.parametrize("cluster", ["local", "debug"])
def test_submitit_runs_a_worker(tmp_path: Path, cluster: str):
    handle = Submitit(cluster, tmp_path / "%j").submit(partial(Path.touch, tmp_path / "done"))
    until(lambda: not handle.alive(), "the worker ends")
    if cluster == "debug":
        handle.job.results()  # debug jobs run when they are asked
    assert (tmp_path / "done").exists()


@pytest.mark.parametrize("around", [contextlib.nullcontext, ignoring_interrupts])
def test_a_cancelled_local_worker_ends(tmp_path: Path, around):
    """Also where interrupts are ignored, by which submitit cancels."""
    with around():
        handle = Submitit("local", tmp_path / "%j").submit(partial(time.sleep, 6000))
    assert handle.alive()
    handle.cancel()
    until(lambda: not handle.alive(), "the worker ends")


def test_slurm_options_reach_sbatch(tmp_path: Path):
    options = {"timeout_min": 600, "mem_gb": 16, "cpus_per_task": 4, "gpus_per_node": 1, "partition": "gpu"}
    text = sbatch(tmp_path / "%j", {**options, "account": "lab", "setup": ["module load cuda"]})
    for line in (
        "time=600",
        "mem=16GB",
        "cpus-per-task=4",
        "gpus-per-node=1",
        "partition=gpu",
        "account=lab",
    ):
        assert f"#SBATCH --{line}\n" in text
    assert "--signal=USR2@90" in text
    assert "module load cuda" in text
    assert f"submitit.core._submit {tmp_path}/%j" in text


def test_slurm_is_refused_where_it_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="executor=slurm"):
        Submitit("slurm", tmp_path / "%j")


def test_preempted_work_is_queued_again(tmp_path: Path):
    work = Requeued(partial(touch, str(tmp_path / "again")))
    work.checkpoint().function()
    assert (tmp_path / "again").exists()


class Dead:
    def alive(self) -> bool:
        return False

    def cancel(self) -> None:
        raise AssertionError


class Living(Dead):
    def __init__(self):
        self.cancelled = False

    def alive(self) -> bool:
        return not self.cancelled

    def cancel(self) -> None:
        self.cancelled = True


class Shelf:
    """An executor whose workers are objects of a given class; it remembers them."""

    def __init__(self, kind):
        self.kind, self.handles = kind, []

    def submit(self, work):
        self.handles.append(self.kind())
        return self.handles[-1]


def test_a_fleet_replaces_the_dead_and_is_no_larger_than_the_work(tmp_path: Path):
    shelf = Shelf(Living)
    fleet = Fleet(shelf, lambda: None, 3, tmp_path)
    fleet.keep(2)
    assert len(shelf.handles) == 2
    fleet.keep(9)
    assert len(shelf.handles) == 3
    shelf.handles[0].cancelled = True
    fleet.keep(9)
    assert len(shelf.handles) == 4
    fleet.cancel()
    assert not any(handle.alive() for handle in shelf.handles)


@pytest.mark.parametrize("fail_fast", [True, False])
def test_the_first_failure_ends_the_workers_where_that_is_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fail_fast: bool
):
    monkeypatch.setattr(controller, "LOOK", 0)
    one, two = (RunTask(name * 16, "memmlp", {}) for name in "12")
    plan = Plan("trial", tmp_path, (), (one, two), fail_fast=fail_fast)
    shelf = Shelf(Living)

    class Looks(Board):
        """One run fails at the second look, the other one at the third."""

        def update(self, plan: Plan) -> None:
            looked.append(len(plan.left()))
            for task in plan.tasks[: len(looked) - 1]:
                plan.run_of(task).folder.mkdir(parents=True, exist_ok=True)
                plan.run_of(task).fail("the loss is nan")

    looked: list[int] = []
    controller.oversee(plan, Fleet(shelf, lambda: None, 2, tmp_path), Looks())
    assert len(looked) == (2 if fail_fast else 3)
    assert [handle.cancelled for handle in shelf.handles] == [fail_fast] * 2


def test_workers_that_never_live_end_the_sweep(tmp_path: Path):
    fleet = Fleet(Shelf(Dead), lambda: None, 2, tmp_path)
    for _ in range(PATIENCE):
        fleet.keep(5)
    with pytest.raises(InputError, match="end as soon as they are started"):
        fleet.keep(5)


@pytest.mark.skipif(importlib.util.find_spec("ray") is not None, reason="Ray is installed")
def test_ray_is_refused_where_it_is_not():
    with pytest.raises(InputError, match="executor=ray: Ray is not installed"):
        Ray()
