"""Workers that are processes of this machine: they work, end, and see their own GPUs."""

import contextlib
import os
import signal
import subprocess
import time
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
import torch
from processes import ignoring_interrupts, until

from memmlp.sweep.executors import local
from memmlp.sweep.executors.local import DebugExecutor, LocalExecutor, list_visible_gpus


def test_a_debug_worker_works_in_this_process(tmp_path: Path):
    (handle,) = DebugExecutor().submit((tmp_path / "done").touch)
    assert (tmp_path / "done").exists()
    assert not handle.alive()
    assert handle.complaint() is None


def test_a_worker_imports_the_package_that_starts_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Where the working folder has another copy of it, which would be found first."""
    (tmp_path / "memmlp").mkdir()
    (tmp_path / "memmlp" / "__init__.py").write_text("")
    monkeypatch.chdir(tmp_path)
    (handle,) = LocalExecutor(tmp_path / "%j").submit((tmp_path / "done").touch)
    until(lambda: not handle.alive(), "the worker ends")
    assert (tmp_path / "done").exists()


@pytest.mark.parametrize("around", [contextlib.nullcontext, ignoring_interrupts])
def test_a_cancelled_local_worker_ends(tmp_path: Path, around):
    with around():
        (handle,) = LocalExecutor(tmp_path / "%j").submit(partial(time.sleep, 6000))
    assert handle.alive()
    handle.cancel()
    until(lambda: not handle.alive(), "the worker ends")
    assert handle.complaint() is None


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="environments are read from /proc")
def test_each_worker_sees_its_own_gpus_and_a_new_one_those_of_the_dead(tmp_path: Path):
    """Two workers have a GPU each, four share them two by two, and without GPUs there is none."""
    go = tmp_path / "go"
    waits = f"while [ ! -e {go} ]; do sleep 0.05; done; echo $CUDA_VISIBLE_DEVICES"
    work = partial(subprocess.getoutput, waits)
    executor = LocalExecutor(tmp_path / "%j", [("0",), ("1",)])
    workers = executor.submit(work, 4)
    assert executor.gpus
    assert [variable(worker) for worker in workers] == ["0", "1", "0", "1"]
    os.kill(workers[1].process.pid, signal.SIGKILL)
    until(lambda: not workers[1].alive(), "the worker is dead")
    workers += executor.submit(work)
    assert variable(workers[4]) == "1"
    bare = LocalExecutor(tmp_path / "%j")
    workers += bare.submit(work)
    assert not bare.gpus
    assert variable(workers[5]) == ""
    alive = [worker for worker in workers if worker is not workers[1]]
    go.touch()
    until(lambda: not any(worker.alive() for worker in alive), "the workers end")
    seen = Counter(worker.complaint() for worker in alive)  # what they returned
    assert seen == {"0": 2, "1": 2, "": 1}


def variable(worker) -> str:
    """What the system has for a worker's process."""
    environment = Path(f"/proc/{worker.process.pid}/environ")
    name = b"CUDA_VISIBLE_DEVICES="

    def entries() -> list[bytes]:  # the parent's, until the process is another program
        return [entry for entry in environment.read_bytes().split(b"\0") if entry.startswith(name)]

    return until(entries, "the process has its environment")[0].removeprefix(name).decode()


@pytest.mark.parametrize(("text", "found"), [
    ("0,1", ("0", "1")), (" 3 , GPU-8f2a ", ("3", "GPU-8f2a")), ("", ()), ("-1", ()), ("2,-1,3", ("2",)),
    ("MIG-a,MIG-b", ("MIG-a", "MIG-b")), (0, ()), (2, ("0", "1")),
])  # fmt: skip
def test_visible_gpus_are_those_of_the_variable_or_all(monkeypatch, text: str | int, found: tuple[str, ...]):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", str(text))
    if isinstance(text, int):
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
        monkeypatch.setattr(torch.cuda, "device_count", lambda: text)
    monkeypatch.setattr(local, "version", lambda _: "2.13.0+cu130")
    assert list_visible_gpus() == found


def test_only_the_last_part_of_the_log_path_is_replaced(tmp_path: Path):
    (handle,) = LocalExecutor(tmp_path / "p%j" / "%j").submit((tmp_path / "done").touch)
    assert handle.folder.parent == tmp_path / "p%j"
    assert handle.folder.name != "%j"
    handle.process.wait()
