"""A sweep on a real Slurm of one node: jobs are cancelled, timed out, queued again and killed."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from command_line import BRIEF, MAIN
from processes import until
from sweep.executors.slurm_cluster import find_missing_commands, list_jobs, running_cluster, slurm

from benchmarks import chaos
from memmlp.runs.lookup import list_runs
from memmlp.runs.run import Run
from memmlp.sweep.executors.local import HEARTBEAT

ASKED = os.environ.get("MEMMLP_SLURM") == "1"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not ASKED, reason="takes ten minutes; run it with `make test-slurm`"),
    pytest.mark.skipif(bool(find_missing_commands()), reason=f"no {' '.join(find_missing_commands())}"),
]
WORDS = [*BRIEF, "plugins=[pace]", "optim.steps=300", "optim.checkpoint_every=5", "optim.validate_every=100"]
WORDS += ["evaluation.modes=[stream]"]
WORKERS, REPLACED, TIMEOUTS = 2, 60.0, 5
PACE = """
import os, time
from pathlib import Path
from memmlp.training import loop

step = loop.train_step

def train_step(*arguments):
    time.sleep(float(Path(os.environ["PACE"]).read_text()))
    return step(*arguments)

loop.train_step = train_step
"""


@pytest.fixture(scope="module")
def cluster() -> Iterator[Path]:
    with running_cluster() as folder:
        yield folder


class Trial:
    """A sweep of two variants, of which each training step takes as long as the file `pace` says."""

    def __init__(self, folder: Path):
        self.folder, self.pace = folder, folder / "pace"
        (folder / "pace.py").write_text(PACE)
        (folder / "trial.yaml").write_text(
            yaml.safe_dump({"variants": {"vq": [], "none": ["memory=none"]}, "seeds": [0]})
        )
        self.set_pace(0.0)
        self.log = time.monotonic()

    def set_pace(self, seconds: float) -> None:
        self.pace.write_text(str(seconds))

    def note(self, text: str) -> None:
        print(f"{time.monotonic() - self.log:6.1f} s  {text}", file=sys.stderr, flush=True)

    def start(self, outputs: str, *words: str) -> subprocess.Popen[bytes]:
        paths = {"PACE": str(self.pace), "PYTHONPATH": str(self.folder)}
        line = [*MAIN, "sweep", str(self.folder / "trial.yaml"), *WORDS, *words, "--workers", str(WORKERS)]
        line += ["--outputs", str(self.folder / outputs)]
        with open(self.folder / f"{outputs}.log", "ab") as log:
            return subprocess.Popen(line, stdout=log, stderr=log, env={**os.environ, **paths})

    def run(self, outputs: str) -> Path:
        assert self.start(outputs).wait() == 0, (self.folder / f"{outputs}.log").read_text()
        return self.folder / outputs

    def list_networks(self, outputs: str) -> list[Run]:
        return [run for run in list_runs(self.folder / outputs) if run.manifest.get("kind") == "memmlp"]

    def list_heartbeats(self, outputs: str) -> set[Path]:
        return set((self.folder / outputs).glob(f"sweeps/*/workers/*/*/{HEARTBEAT}"))


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Trial:
    trial = Trial(tmp_path_factory.mktemp("a trial's 50 $folder"))
    trial.run("calm")
    return trial


def is_trained_further(run: Run, step: int) -> bool:
    return run.step > step and run.checkpoint.exists()


def find_processes(text: str) -> list[int]:
    lines = slurm("ps", "-eo", "pid=,args=").splitlines()
    return [int(line.split(None, 1)[0]) for line in lines if text in line and "ps -eo" not in line]


def find_raw_job(name: str) -> str:
    fields = slurm("scontrol", "show", "job", name).split()
    return next(field for field in fields if field.startswith("JobId=")).partition("=")[2]


def kill_step(name: str) -> None:
    """Kill Slurm's daemon of a job's step; its worker lives on."""
    (step,) = find_processes(f"slurmstepd: [{find_raw_job(name)}.0]")
    os.kill(step, signal.SIGKILL)


def kill_step_and_worker(name: str) -> None:
    (step,) = find_processes(f"slurmstepd: [{find_raw_job(name)}.0]")
    children = [int(pid) for pid in slurm("pgrep", "--parent", str(step)).split()]
    for pid in (step, *children):
        os.kill(pid, signal.SIGKILL)


EVENTS: dict[str, Callable[[str], object]] = {
    "scancel": lambda name: slurm("scancel", name),
    "scontrol requeue": lambda name: slurm("scontrol", "requeue", name),
    "kill -9 of the step and its worker": kill_step_and_worker,
}


def test_a_disturbed_sweep_ends_as_an_undisturbed_one(cluster: Path, trial: Trial):
    trial.set_pace(1.0)
    words = ["executor=slurm", "slurm.time=60"]
    controller = trial.start("stormy", *words)
    until(lambda: len(list_training("stormy", trial)) == WORKERS, "both runs are trained", controller)
    for name, disturb in EVENTS.items():
        before, began = trial.list_heartbeats("stormy"), time.monotonic()
        job = next(job for job, state in sorted(list_jobs().items()) if state == "RUNNING")
        disturb(job)
        until(lambda before=before: trial.list_heartbeats("stormy") - before, name, controller)
        seconds = time.monotonic() - began
        trial.note(f"{name} of job {job}: replaced after {seconds:.0f} s")
        assert seconds < REPLACED, name
        until(lambda: len(list_training("stormy", trial)) == WORKERS, "both runs go on", controller)
    kill_step(next(job for job, state in sorted(list_jobs().items()) if state == "RUNNING"))
    trial.note("kill -9 of a step's daemon: its worker works on")
    controller.kill()
    controller.wait()
    steps = {run.id: run.step for run in trial.list_networks("stormy")}
    until(
        lambda: all(is_trained_further(run, steps[run.id]) for run in trial.list_networks("stormy")),
        "trained without a controller",
    )
    trial.note("controller killed: both runs go on")
    trial.set_pace(0.0)
    controller = trial.start("stormy", *words)
    assert controller.wait() == 0, (trial.folder / "stormy.log").read_text()
    assert chaos.compare(trial.folder / "calm", trial.folder / "stormy") == []
    trial.note("0 differences")


def list_training(outputs: str, trial: Trial) -> list[Run]:
    return [run for run in trial.list_networks(outputs) if run.activity == "training" and run.step]


def test_a_sweep_of_jobs_that_time_out_ends_as_an_undisturbed_one(cluster: Path, trial: Trial):
    trial.set_pace(1.0)
    controller = trial.start("timed", "executor=slurm", "slurm.time=1")

    def count_attempts() -> int:
        return min((len(run.manifest["attempts"]) for run in trial.list_networks("timed")), default=0)

    for number in range(1, TIMEOUTS + 2):
        until(lambda number=number: count_attempts() >= number, f"attempt {number}", controller)
        trial.note(f"slurm.time=1: attempt {number} of both runs")
    trial.set_pace(0.0)
    assert controller.wait() == 0, (trial.folder / "timed.log").read_text()
    assert chaos.compare(trial.folder / "calm", trial.folder / "timed") == []
    trial.note("0 differences")
