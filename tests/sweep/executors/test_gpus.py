"""The GPUs of a machine are shared out among its workers."""

from __future__ import annotations

import os

import pytest
import torch

from memmlp.common.errors import InputError
from memmlp.sweep.executors.gpus import shares, visible_gpus, worker_count


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("0,1", ("0", "1")), (" 3 , GPU-8f2a ", ("3", "GPU-8f2a")), ("", ()), ("-1", ()), ("2,-1,3", ("2",)),
        ("MIG-a,MIG-b", ("MIG-a", "MIG-b")),
    ],
)  # fmt: skip
def test_visible_are_those_of_the_variable(monkeypatch: pytest.MonkeyPatch, words: str, found: tuple):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", words)
    assert visible_gpus() == found


@pytest.mark.parametrize("count", [0, 2])
def test_without_the_variable_all_are_visible(monkeypatch: pytest.MonkeyPatch, count: int):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    assert visible_gpus() == ("0", "1")[:count]


def test_shares():
    four = ("0", "1", "2", "3")
    assert shares(four) == [("0",), ("1",), ("2",), ("3",)]
    assert shares(four, 2) == [("0", "1"), ("2", "3")]
    assert shares(four, 3) == [("0", "1", "2")]
    assert shares(four, 0) == []
    assert shares(()) == []
    for gpus, size, line in (
        (("0", "1"), 3, "up to 2; visible here is 0, 1"),
        ((), 1, "visible here is no GPU"),
    ):
        with pytest.raises(InputError, match=f"--gpus-per-worker {size}: allowed is {'.*' + line}"):
            shares(gpus, size)


def test_worker_counts():
    two = [("0",), ("1",)]
    assert worker_count(two, None, None) == 2
    assert worker_count(two, 5, None) == 5  # shared as evenly as it goes
    assert worker_count(two, None, 3) == 6
    assert worker_count(two, 4, 3) == 4
    assert worker_count([], 4, None) == 4
    assert worker_count([], None, None) == os.cpu_count()
    with pytest.raises(InputError, match="--workers 7: allowed is up to 6, with --workers-per-gpu 3"):
        worker_count(two, 7, 3)
    with pytest.raises(InputError, match="--workers-per-gpu 2: allowed where workers have GPUs"):
        worker_count([], 4, 2)
