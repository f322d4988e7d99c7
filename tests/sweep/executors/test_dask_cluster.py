"""Dask: its options, and a cluster of processes on this machine of which two say that they have a GPU."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from dask_work import stay
from processes import until

from memmlp.common.errors import InputError
from memmlp.sweep.executors import parse_settings
from memmlp.sweep.executors.dask_cluster import SETTINGS, Dask


def parse(words: dict[str, str]):
    return parse_settings("dask", words, SETTINGS)


def test_options():
    found = parse({"address": "head:8786", "resources.GPU": "1", "resources.memory": "2.5"})
    assert found == {"address": "head:8786", "resources": {"GPU": 1.0, "memory": 2.5}}


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ({"gpus": "1"}, "dask.gpus: no such key; expected one of address, resources.NAME"),
        ({"resources.GPU": "much"}, "dask.resources.GPU=much: must be a number"),
    ],
)
def test_bad_options_are_one_line(words: dict[str, str], line: str):
    with pytest.raises(InputError, match=line):
        parse(words)


def test_a_cluster_must_be_named(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("distributed")
    monkeypatch.delenv("DASK_SCHEDULER_ADDRESS", raising=False)
    with pytest.raises(InputError, match=r"dask\.address=HOST:PORT"):
        Dask({})


@pytest.fixture
def cluster() -> Iterator[Any]:
    """Two worker processes, each of which declares a GPU."""
    distributed = pytest.importorskip("distributed")
    settings = {"n_workers": 2, "threads_per_worker": 2, "dashboard_address": None, "resources": {"GPU": 1}}
    with distributed.LocalCluster(**settings) as made:
        yield made


@pytest.fixture
def connect(cluster: Any) -> Iterator[Callable[..., Dask]]:
    """Makes executors on the cluster, whose connections end before it does."""
    made: list[Dask] = []

    def connected(gpus: bool = True, **words: str) -> Dask:
        made.append(Dask(parse({"address": cluster.scheduler_address, **words}), gpus))
        return made[-1]

    yield connected
    for one in made:
        one.client.close()


def begun(folder: Path, count: int) -> list[Path]:
    return until(lambda: len(found := [*folder.glob("*.txt")]) == count and found, f"{count} began")


def gone(pid: int) -> bool:
    return not Path("/proc", str(pid)).exists()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_workers_take_up_gpus_and_are_ended(cluster: Any, connect: Callable[..., Dask], tmp_path: Path):
    made = connect()
    assert (made.gpus, made.resources) == (True, {"GPU": 1.0})
    (worker,) = made.submit(partial(os.getenv, "NO_SUCH_VARIABLE", "a line"))
    until(lambda: not worker.alive(), "the worker ends")
    assert worker.complaint() == "a line"

    both = made.submit(partial(stay, tmp_path), 2)
    found = begun(tmp_path, 2)
    assert len(both) == len({path.read_text() for path in found}) == 2
    asked = [cluster.scheduler.tasks[worker.future.key].resource_restrictions for worker in both]
    assert asked == [{"GPU": 1.0}] * 2
    os.kill(int(found[0].stem), signal.SIGKILL)
    until(lambda: sum(worker.alive() for worker in both) == 1, "one is dead")
    dead = next(worker for worker in both if not worker.alive())
    assert dead.complaint() is None
    assert "ended with -9" in str(dead.future.exception())
    (third,) = made.submit(partial(stay, tmp_path), 1)  # in its place
    begun(tmp_path, 3)
    for worker in (*both, third):
        worker.cancel()
    until(lambda: all(gone(int(path.stem)) for path in tmp_path.glob("*.txt")), "all ended")

    bare = connect(gpus=False)
    (worker,) = bare.submit(partial(os.getenv, "CUDA_VISIBLE_DEVICES", "all"))
    until(lambda: not worker.alive(), "the worker ends")
    assert worker.complaint() is None  # empty: it sees none
