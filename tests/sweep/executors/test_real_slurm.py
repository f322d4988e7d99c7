"""A sweep on a real Slurm of one node: jobs are cancelled, timed out, queued again and killed."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path

import pytest
import yaml
from command_line import BRIEF, MAIN
from processes import until
from sweep.executors.slurm_cluster import find_missing_commands, list_ends, list_jobs, running_cluster, slurm

from benchmarks import chaos
from memmlp.common.files import atomic_write, file_digest
from memmlp.runs.lookup import list_runs
from memmlp.runs.run import Run
from memmlp.sweep.executors.local import HEARTBEAT
from memmlp.sweep.executors.slurm import MIN_WARNED_MINUTES

ASKED = os.environ.get("MEMMLP_SLURM") == "1"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not ASKED, reason="takes 25 minutes; run it with `make test-slurm`"),
    pytest.mark.skipif(bool(find_missing_commands()), reason=f"no {' '.join(find_missing_commands())}"),
]
WORDS = [*BRIEF, "plugins=[pace]", "term=pace", "optim.steps=300", "optim.checkpoint_every=5"]
WORDS += ["optim.log_every=5", "optim.validate_every=100", "evaluation.modes=[stream]"]
WORKERS, REPLACED, TIMEOUTS = 2, 60.0, 5
SETTLED = 10.0  # seconds after which Slurm can start a job again that it has just queued again
PACE = """
import os, time
from pathlib import Path
from memmlp.common.components import component
from memmlp.common.settings import Settings, setting
from memmlp.training.losses import Term

@component("term", "pace", builds="Pace")
class PaceSettings(Settings):
    weight: float = setting(None, 1.0)

class Pace(Term):
    def __call__(self, *arguments):
        time.sleep(float(Path(os.environ["PACE"]).read_text()))
        return {}
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
        atomic_write(self.pace, str(seconds))

    def note(self, text: str) -> None:
        print(f"{time.monotonic() - self.log:6.1f} s  {text}", file=sys.stderr, flush=True)

    def start(self, outputs: str, *words: str) -> subprocess.Popen[bytes]:
        paths = {"PACE": str(self.pace), "PYTHONPATH": str(self.folder)}
        line = [*MAIN, "sweep", str(self.folder / "trial.yaml"), *WORDS, *words, "--workers", str(WORKERS)]
        line += ["--outputs", str(self.folder / outputs)]
        with open(self.folder / f"{outputs}.log", "ab") as log:
            return subprocess.Popen(line, stdout=log, stderr=log, env={**os.environ, **paths})

    def list_networks(self, outputs: str) -> list[Run]:
        return [run for run in list_runs(self.folder / outputs) if run.manifest.get("kind") == "memmlp"]

    def list_training(self, outputs: str) -> list[Run]:
        return [run for run in self.list_networks(outputs) if run.activity == "training" and run.step]

    def wait_for_training(self, outputs: str, controller: subprocess.Popen[bytes]) -> None:
        until(lambda: len(self.list_training(outputs)) == WORKERS, "both runs are trained", controller)

    def wait_for_progress(self, outputs: str) -> None:
        """Wait until both runs are trained further from a checkpoint."""
        steps = {run.id: run.step for run in self.list_networks(outputs)}

        def has_progress() -> bool:
            runs = self.list_networks(outputs)
            return all(run.step > steps[run.id] and run.checkpoint.exists() for run in runs)

        until(has_progress, "both runs are trained further")

    def kill(self, outputs: str, controller: subprocess.Popen[bytes]) -> None:
        controller.kill()
        controller.wait()
        self.wait_for_progress(outputs)
        self.note("controller killed: both runs go on")

    def check(self, outputs: str) -> None:
        """Check that the weights are those of the undisturbed sweep."""
        assert chaos.compare(self.folder / "calm", self.folder / outputs) == []
        weights = ", ".join(sorted(file_digest(run.model)[:16] for run in self.list_networks(outputs)))
        self.note(f"{outputs}: 0 differences; weights {weights}")

    def list_heartbeats(self, outputs: str) -> set[Path]:
        return set((self.folder / outputs).glob(f"sweeps/*/workers/*/*/{HEARTBEAT}"))


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Trial:
    trial = Trial(tmp_path_factory.mktemp("a trial's 50 $folder"))
    assert trial.start("calm").wait() == 0, (trial.folder / "calm.log").read_text()
    trial.check("calm")
    return trial


def find_processes(text: str) -> list[int]:
    lines = slurm("ps", "-eo", "pid=,args=").splitlines()
    return [int(line.split(None, 1)[0]) for line in lines if text in line and "ps -eo" not in line]


def show(job: str) -> dict[str, str]:
    return dict(word.split("=", 1) for word in slurm("scontrol", "show", "job", job).split() if "=" in word)


def kill_step(name: str) -> None:
    """Kill Slurm's daemon of a job's step; its worker lives on."""
    (step,) = find_processes(f"slurmstepd: [{show(name)['JobId']}.0]")
    os.kill(step, signal.SIGKILL)


def kill_step_and_worker(name: str) -> None:
    (step,) = find_processes(f"slurmstepd: [{show(name)['JobId']}.0]")
    (worker,) = (int(pid) for pid in slurm("pgrep", "--parent", str(step)).split())
    for pid in (step, worker):
        os.kill(pid, signal.SIGKILL)


EVENTS: dict[str, tuple[Callable[[str], object], str]] = {
    "scancel": (lambda name: slurm("scancel", name), "CANCELLED"),
    "scontrol requeue": (lambda name: slurm("scontrol", "requeue", name), "PENDING"),
    "kill -9 of the step and its worker": (kill_step_and_worker, "CANCELLED"),  # by the controller
}
"""What happens to a job, and its state afterwards in Slurm's record."""


def test_a_disturbed_sweep_ends_as_an_undisturbed_one(cluster: Path, trial: Trial):
    trial.set_pace(1.0)
    words = ["executor=slurm", "slurm.time=60"]
    controller = trial.start("stormy", *words)
    trial.wait_for_training("stormy", controller)
    for name, (disturb, state) in EVENTS.items():
        before, began = trial.list_heartbeats("stormy"), time.monotonic()
        job = find_running_job()
        disturb(job)
        until(lambda before=before: trial.list_heartbeats("stormy") - before, name, controller)
        seconds = time.monotonic() - began
        trial.note(f"{name} of job {job}: replaced after {seconds:.0f} s")
        assert seconds < REPLACED, name
        assert state in [end["JobState"] for end in list_ends(cluster) if end["name"] == job], name
        trial.wait_for_training("stormy", controller)
    kill_step(find_running_job())
    trial.note("kill -9 of a step's daemon: its worker works on")
    trial.kill("stormy", controller)
    trial.set_pace(0.0)
    assert trial.start("stormy", *words).wait() == 0, (trial.folder / "stormy.log").read_text()
    trial.check("stormy")


def find_running_job() -> str:
    return next(job for job, state in sorted(list_jobs().items()) if state == "RUNNING")


def test_a_sweep_of_jobs_that_time_out_ends_as_an_undisturbed_one(cluster: Path, trial: Trial):
    trial.set_pace(1.5)
    controller = trial.start("timed", "executor=slurm", "slurm.time=1")

    def count_trainings() -> int:
        attempts = [run.manifest["attempts"] for run in trial.list_networks("timed")]
        return min((sum(one["stage"] == "training" for one in each) for each in attempts), default=0)

    until(lambda: count_trainings() > TIMEOUTS, "both runs are interrupted five times", controller)
    trial.set_pace(0.0)
    assert controller.wait() == 0, (trial.folder / "timed.log").read_text()
    ends = [end for end in list_ends(cluster) if end["TimeLimit"] == "1"]
    timeouts = sorted(end["EndTime"] for end in ends if end["JobState"] == "TIMEOUT")
    starts = sorted(end["StartTime"] for end in ends)[WORKERS:]
    pairs = zip(timeouts, starts, strict=False)
    seconds = [(datetime.fromisoformat(start) - datetime.fromisoformat(end)).seconds for end, start in pairs]
    trial.note(f"{len(timeouts)} jobs timed out, replaced after {seconds} s")
    assert len(seconds) >= WORKERS * TIMEOUTS  # the last one needs no successor if no run is left
    assert max(seconds) < REPLACED
    trial.check("timed")


def test_jobs_that_time_out_without_a_controller_go_on(cluster: Path, trial: Trial):
    """Slurm warns a job before its time limit; the job then queues itself again."""
    trial.set_pace(1.0)
    words, earlier = ["executor=slurm", f"slurm.time={MIN_WARNED_MINUTES}"], set(list_jobs())
    controller = trial.start("alone", *words)
    trial.wait_for_training("alone", controller)
    trial.kill("alone", controller)
    jobs = sorted(set(list_jobs()) - earlier)  # a job whose step's daemon was killed stays in the queue
    for job in jobs:
        slurm("scontrol", "update", f"JobId={job}", "TimeLimit=3")
    for number in range(1, TIMEOUTS + 1):
        trial.set_pace(5.0)
        until(lambda number=number: all(int(show(job)["Restarts"]) >= number for job in jobs), "a time-out")
        time.sleep(SETTLED)
        for job in jobs:
            slurm("scontrol", "update", f"JobId={job}", "StartTime=now")  # otherwise after two minutes
        trial.set_pace(0.2)
        trial.wait_for_progress("alone")
        trial.note(f"time-out {number} of jobs {', '.join(jobs)}: both runs go on")
    trial.set_pace(0.0)
    assert trial.start("alone", *words).wait() == 0, (trial.folder / "alone.log").read_text()
    trial.check("alone")
