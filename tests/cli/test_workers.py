"""What the command line says of workers, and what they do without the GPU that they were to have."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from memmlp.cli.workers import Workers, split_executor, start_fleet
from memmlp.common.errors import InputError
from memmlp.config import worker_process
from memmlp.sweep.plan import Plan
from memmlp.training import devices


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Torch finds the GPUs of this process."""
    monkeypatch.setattr(devices, "describe_missing_gpu", lambda: None)


@pytest.mark.parametrize(("visible", "options", "wanted", "shares", "number"), [
    ("0,1", {}, ["auto"], [("0",), ("1",)], 2),
    ("0,1", {"count": 4}, ["auto", "cpu"], [("0",), ("1",)], 4),
    ("0,1", {"workers_per_gpu": 3}, ["cuda"], [("0",), ("1",)], 6),
    ("0,1,2", {"gpus_per_worker": 2}, ["cuda"], [("0", "1")], 1),
    ("0,1", {"gpus_per_worker": 0, "count": 3}, ["auto"], [], 3), ("0,1", {"count": 3}, ["cpu"], [], 3),
    ("", {"count": 3}, ["auto"], [], 3), ("0,1", {"executor": "my.Cloud", "count": 3}, ["cuda"], [], 3),
])  # fmt: skip
def test_gpus_of_workers(found, monkeypatch, visible, options, wanted, shares, number):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    workers = Workers(**options)
    assert (workers.make_gpu_shares(wanted), workers.count_workers(shares)) == (shares, number)


@pytest.mark.parametrize(("wanted", "visible", "executor", "line"), [
    ("cuda:1", "0,1", "local", "device=cuda:1"),
    ("cuda:1", "", "my.Cloud", "device=cuda:1"),
    ("cuda", "", "local", "device=cuda: no GPU is visible here"),
    ("auto", "0", "local", "torch .* does not find one"),
])  # fmt: skip
def test_runs_that_could_not_have_their_gpu_are_refused(monkeypatch, wanted, visible, executor, line):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    with pytest.raises(InputError, match=line):
        Workers(executor).make_gpu_shares([wanted])


@pytest.mark.parametrize("option", ["gpus_per_worker", "workers_per_gpu"])
def test_options_of_local_workers_are_refused_elsewhere(option: str):
    with pytest.raises(InputError, match=f"--{option.replace('_', '-')}: needs workers of this machine"):
        Workers("my.Cloud", **{option: 1})


def test_settings_belong_to_one_executor():
    words = ("executor=slurm", "slurm.partition=long", "seed=1")
    executor, own, rest = split_executor(words)
    assert (executor, own, rest) == ("slurm", {"partition": "long"}, ("seed=1",))
    with pytest.raises(InputError, match=r"slurm.partition: needs executor=slurm"):
        split_executor(words[1:])
    with pytest.raises(InputError, match="executor"):
        split_executor(("executor=",))


@pytest.mark.parametrize(("executor", "gives", "wanted", "gpu"), [
    ("local", True, ["auto"], True), ("local", False, ["auto"], False), ("my.Cloud", True, ["cuda"], True),
    ("my.Cloud", True, ["cpu"], False), ("my.Cloud", True, ["cpu", "auto"], True),
    ("my.Cloud", False, ["auto"], False),
])  # fmt: skip
def test_workers_know_whether_they_are_to_have_a_gpu(
    found, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, executor, gives, wanted, gpu
):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0" if gives else "")
    monkeypatch.setattr(Workers, "start_executor", lambda *_, **__: SimpleNamespace(gpus=gives))
    path, fleet = start_fleet(tmp_path, Plan("s", tmp_path, (), ()), Workers(executor, count=1), wanted)
    assert fleet.work.args[-1] is gpu
    monkeypatch.setattr(devices, "describe_missing_gpu", lambda: "none is there")
    monkeypatch.setattr(worker_process, "work_on_plan", lambda *_: None)
    assert fleet.work() == ("none is there" if gpu else None)
    assert path.exists()
