"""Garbage collection, ends, imports of children, and the share of a core."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import memmlp
from memmlp.common import processes
from memmlp.common.processes import (
    build_import_variables,
    finish_uninterrupted,
    treat_termination_as_interrupt,
)

FILE = "import memmlp; print(memmlp.__file__)"


@pytest.fixture
def foreign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with another copy of the package, which a child without our environment imports."""
    (tmp_path / "memmlp").mkdir()
    (tmp_path / "memmlp" / "__init__.py").write_text("")
    monkeypatch.chdir(tmp_path)
    assert Path(found()) == tmp_path / "memmlp" / "__init__.py"
    return tmp_path


def found(**environment: str) -> str:
    line = [sys.executable, "-c", FILE]
    answer = subprocess.run(line, env=os.environ | environment, capture_output=True, text=True, check=True)
    return answer.stdout.strip()


def test_a_import_environment_the_same_package(foreign: Path):
    assert found(**build_import_variables()) == memmlp.__file__


def test_an_end_that_has_begun_is_not_interrupted_and_a_request_to_end_is_a_ctrl_c():
    ended = []

    def end() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        ended.append(True)

    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(KeyboardInterrupt), finish_uninterrupted(end):
        raise KeyboardInterrupt
    assert ended
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), treat_termination_as_interrupt():
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) == before


def test_usable_cores_follow_affinity_and_slurm(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(processes, "_read_cgroup_quotas", lambda: [])
    monkeypatch.setattr(processes.os, "sched_getaffinity", lambda process: {*range(8)}, raising=False)
    monkeypatch.delenv("SLURM_CPUS_PER_TASK", raising=False)
    assert processes.count_usable_cores() == 8
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "4")
    assert processes.count_usable_cores() == 4
    monkeypatch.setattr(processes, "_read_cgroup_quotas", lambda: [2.5])
    assert processes.count_usable_cores() == 3


def test_quotas_of_both_cgroup_versions(tmp_path: Path):
    (tmp_path / "cgroup").write_text("4:cpu,cpuacct:/job\n0::/user/job\n")
    files = {
        "user/cpu.max": "150000 100000\n",
        "user/job/cpu.max": "max 100000\n",
        "cpu.max": "400000 100000\n",
    }
    files |= {"cpu/job/cpu.cfs_quota_us": "50000\n", "cpu/job/cpu.cfs_period_us": "100000\n"}
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert sorted(processes._read_cgroup_quotas(tmp_path / "cgroup", tmp_path)) == [0.5, 1.5, 4.0]
