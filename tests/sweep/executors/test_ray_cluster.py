"""Ray: its options, and where it is installed a cluster on this machine with two GPUs that it is told of."""

import importlib.util
import os
import signal
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from command_line import BRIEF, run
from processes import until

from memmlp.common.errors import InputError
from memmlp.sweep.executors import parse_settings
from memmlp.sweep.executors.ray_cluster import SETTINGS, Ray

RAY = importlib.util.find_spec("ray") is not None


def parse(words: dict[str, str]):
    return parse_settings("ray", words, SETTINGS)


def test_options(tmp_path: Path):
    environment = tmp_path / "env.yaml"
    environment.write_text("env_vars: {A: b}\n")
    words = {"address": "ray://head:10001", "num_gpus": "0.5", "num_cpus": "4", "memory_gb": "2"}
    words |= {"resources.a100": "1", "runtime_env": str(environment)}
    assert parse(words) == {
        "address": "ray://head:10001", "num_gpus": 0.5, "num_cpus": 4.0, "memory_gb": 2.0,
        "resources": {"a100": 1.0}, "runtime_env": {"env_vars": {"A": "b"}},
    }  # fmt: skip


@pytest.mark.parametrize(("words", "line"), [
    ({"gpus": "1"}, "ray.gpus: no such key; expected one of address"),
    ({"num_gpus": "-1"}, "ray.num_gpus=-1: must be a number"),
    ({"resources.x": "much"}, "ray.resources.x=much: must be a number"),
    ({"runtime_env": "/none.yaml"}, "ray.runtime_env=/none.yaml: no such file"),
    ({"runtime_env": __file__}, "ray.runtime_env"),
])  # fmt: skip
def test_bad_options_are_one_line(words: dict[str, str], line: str):
    with pytest.raises(InputError, match=line) as error:
        parse(words)
    assert "\n" not in str(error.value)


@pytest.mark.skipif(RAY, reason="Ray is installed")
def test_ray_is_refused_where_it_is_not():
    with pytest.raises(InputError, match="executor=ray"):
        Ray({})


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Ray]:
    """Ray on this machine, which says that it has two GPUs."""
    ray = pytest.importorskip("ray")
    monkeypatch.setenv("RAY_worker_niceness", "0")  # by default they wait for whatever else is tested
    monkeypatch.setattr(ray, "init", partial(ray.init, num_cpus=2, num_gpus=2))
    yield Ray(parse({}))
    ray.shutdown()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_workers_have_a_gpu_each_the_dead_are_known_and_a_sweep_is_done(cluster: Ray, tmp_path: Path):
    def stay() -> None:
        """Write the GPUs that this worker sees into a file named by its process, and stay."""
        mine = tmp_path / f"{os.getpid()}.tmp"
        mine.write_text(os.environ["CUDA_VISIBLE_DEVICES"])
        mine.rename(mine.with_suffix(".txt"))
        time.sleep(6000)

    assert (cluster.gpus, cluster.num_gpus) == (True, 1)
    workers = cluster.submit(partial(os.getenv, "CUDA_VISIBLE_DEVICES"), 1)
    until(lambda: not workers[0].alive(), "the worker ends")
    assert workers[0].complaint() in ("0", "1")
    both = cluster.submit(stay, 2)
    found = until(
        lambda: len(list(tmp_path.glob("*.txt"))) == 2 and list(tmp_path.glob("*.txt")), "both begin"
    )
    assert sorted(path.read_text() for path in found) == ["0", "1"]
    os.kill(int(found[0].stem), signal.SIGKILL)
    until(lambda: sum(worker.alive() for worker in both) == 1, "one is dead")
    dead = next(worker for worker in both if not worker.alive())
    assert dead.complaint() is None
    (alive,) = (worker for worker in both if worker.alive())
    alive.cancel()
    until(lambda: not alive.alive(), "the other is ended")
    bare = Ray(parse({"num_gpus": "0"}))
    assert not bare.gpus
    (worker,) = bare.submit(partial(os.getenv, "CUDA_VISIBLE_DEVICES"))
    until(lambda: not worker.alive(), "the worker ends")
    assert worker.complaint() == ""
    (tmp_path / "trial.yaml").write_text("variants: {none: [memory=none]}")
    words = ["sweep", "trial.yaml", *BRIEF, "export.graph=off", "executor=ray", "ray.num_gpus=0"]
    assert "1 of 1 runs done" in run(tmp_path, *words, "--workers", "1")
