"""Slurm by its sbatch file, and by a stand-in for its commands."""

from functools import partial
from pathlib import Path

import pytest

from memmlp.common.errors import InputError
from memmlp.sweep.executors import slurm
from memmlp.sweep.executors.local import HEARTBEAT
from memmlp.sweep.executors.slurm import Slurm, SlurmOptions, format_batch_script, parse_slurm_options


def lines(tmp_path: Path, **words: str) -> list[str]:
    options = parse_slurm_options({"time": "60", **words})
    return format_batch_script(tmp_path / "%j", options, 1).splitlines()


def test_options_reach_sbatch(tmp_path: Path):
    words = {"time": "600", "mem_gb": "16", "cpus": "4", "gpus": "1", "partition": "gpu", "account": "lab"}
    words |= {"setup": "module load cuda", "mail-user": "me@lab.org", "exclusive": "true", "gres": "disk:1"}
    words["comment"] = "it's a\\b"
    found = lines(tmp_path, **words, overcommit="false")
    for line in (
        "time=600", "mem=16GB", "cpus-per-task=4", "gpus-per-node=1", "partition=gpu", "account=lab",
        "mail-user=me@lab.org", "exclusive", "gres=disk:1", "job-name=memmlp", "signal=B:USR2@90", "requeue",
        """comment='it'"'"'s a\\\\b'""",
    ):  # fmt: skip
        assert f"#SBATCH --{line}" in found
    assert "module load cuda" in found
    assert "overcommit" not in "\n".join(found)


def test_short_jobs_and_those_that_may_not_are_not_queued_again(tmp_path: Path):
    """Slurm's warning would come at the start of a job of a minute, which would never get further."""
    for words in ({"time": "1"}, {"no_requeue": "true"}):
        found = "\n".join(lines(tmp_path, **words))
        assert "signal" not in found
        assert "scontrol" not in found
        assert ("--requeue" in found) is ("no_requeue" not in words)


@pytest.mark.parametrize(("text", "minutes"), [
    ("90", 90), ("90:30", 91), ("10:00:00", 600), ("1:30:01", 91), ("2-0", 2880), ("7-12:30", 10830),
    ("1-02:03:00", 1563),
])  # fmt: skip
def test_times_are_slurms(tmp_path: Path, text: str, minutes: int):
    assert parse_slurm_options({"time": text}).minutes == minutes
    assert f"#SBATCH --time={text}" in lines(tmp_path, time=text)


@pytest.mark.parametrize(("settings", "gpu"), [
    ({"gpus": "1"}, True), ({"gpus": "a100:2"}, True), ({"gpus_per_task": "1"}, True),
    ({"gres": "gpu:1"}, True), ({"gres": "disk:1"}, False), ({"mem_per_gpu": "8G"}, False), ({}, False),
])  # fmt: skip
def test_whether_a_job_is_to_have_a_gpu(settings: dict[str, str], gpu: bool):
    assert parse_slurm_options({"time": "60", **settings}).gpu is gpu


def test_a_container_is_srun_s(tmp_path: Path):
    words = {"container_image": "lab/memmlp:1", "container_mounts": "/data:/data", "srun": "--mpi=none -v"}
    found = lines(tmp_path, **words, python="python3")
    (command,) = [line for line in found if line.startswith("srun")]
    for word in ("--container-image=lab/memmlp:1", "--container-mounts=/data:/data", "--mpi=none", "-v"):
        assert f" {word} " in command
    assert " python3 -u -m memmlp" in command
    assert not [line for line in found if line.startswith("#SBATCH --container")]


def test_bad_options_are_one_line():
    for settings, line in (
        ({"time": "1h"}, "slurm.time=1h: expected MINUTES"), ({"comment": "a\nb"}, "expected the long name"),
        ({"cpus": "0"}, "slurm.cpus=0"), ({"array": "0-3"}, "set by memmlp"),
        ({"gpus": "-1"}, "slurm.gpus=-1"), ({"nodes": "2"}, "slurm.nodes: cannot be set"),
        ({"comment": ""}, "expected the long name"), ({"gpus": "1"}, "slurm.time: has no value"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=line) as error:
            parse_slurm_options(settings)
        assert "\n" not in str(error.value)


def test_slurm_is_refused_where_it_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="executor=slurm"):
        Slurm(tmp_path / "%j", SlurmOptions())


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Slurm's commands: the queue is the file `queue`, and `given` is what they were given."""
    folder = tmp_path / "bin"
    folder.mkdir()
    (folder / "queue").write_text("")
    keep = f'cp "$1" {folder}/given.sh; env > {folder}/given.env; echo x >> {folder}/calls'
    keep += '; echo "Submitted batch job 42"'
    cancel = f'echo "$@" >> {folder}/cancelled'
    for name, line in {"sbatch": keep, "squeue": f"cat {folder}/queue", "scancel": cancel}.items():
        (folder / name).write_text(f"#!/bin/sh\n{line}\n")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(folder), prepend=":")
    return folder


def submit(tmp_path: Path, count: int = 1, **words: str) -> list[slurm.Job]:
    options = parse_slurm_options({"time": "1-0", **words})
    return Slurm(tmp_path / "logs" / "%j", options).submit(partial(print, "work"), count)


def test_workers_are_submitted_at_once(tmp_path: Path, cluster: Path, monkeypatch: pytest.MonkeyPatch):
    """The job of a controller inside Slurm does not count."""
    monkeypatch.setenv("SLURM_MEM_PER_CPU", "1")
    monkeypatch.setenv("SLURM_CONF", "slurm.conf")
    handles = submit(tmp_path, 3, gpus="1")
    assert [handle.name for handle in handles] == ["42_0", "42_1", "42_2"]
    assert (cluster / "calls").read_text() == "x\n"
    given = (cluster / "given.sh").read_text()
    assert "#SBATCH --array=0-2\n" in given
    assert "#SBATCH --time=1-0" in given
    environment = (cluster / "given.env").read_text()
    assert "SLURM_CONF=" in environment
    assert "SLURM_MEM_PER_CPU" not in environment


def test_a_job_lives_while_it_waits_and_while_its_heart_beats(
    tmp_path: Path, cluster: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(slurm, "QUEUE_INTERVAL", -1.0)
    (job,) = submit(tmp_path)
    for state in ("PENDING", "RUNNING"):
        (cluster / "queue").write_text(f"41_0 RUNNING\n42_0 {state}\n")
        assert job.alive()
    (job.folder / HEARTBEAT).touch()
    assert job.alive()
    monkeypatch.setattr(slurm, "SILENCE", -1.0)
    (cluster / "queue").write_text("42_0 SUSPENDED None\n")
    assert job.alive()
    assert not (cluster / "cancelled").exists()
    (cluster / "queue").write_text("42_0 RUNNING\n")
    assert not job.alive()
    assert (cluster / "cancelled").read_text() == "42_0\n"
    assert job.complaint() is None


def test_a_job_that_slurm_holds_or_no_longer_lists_is_replaced(
    tmp_path: Path, cluster: Path, monkeypatch: pytest.MonkeyPatch
):
    """Without an answer of Slurm it may be waiting."""
    monkeypatch.setattr(slurm, "QUEUE_INTERVAL", -1.0)
    (job,) = submit(tmp_path)
    assert not job.alive()
    assert "42_0" in (job.complaint() or "")
    (cluster / "queue").write_text("42_0 PENDING Priority\n")
    assert job.alive()
    (cluster / "queue").write_text("42_0 PENDING launch failed requeued held\n")
    assert not job.alive()
    assert (cluster / "cancelled").read_text() == "42_0\n"
    (cluster / "squeue").write_text("#!/bin/sh\nexit 1\n")
    assert job.alive()


def test_commands_name_the_cluster(tmp_path: Path, cluster: Path):
    (job,) = submit(tmp_path, clusters="far")
    job.cancel()
    assert (cluster / "cancelled").read_text() == "--clusters=far 42_0\n"


@pytest.mark.parametrize("python", [None, "srun python3"])
def test_jobs_import_the_package_that_submits_them(tmp_path: Path, python: str | None):
    """Unless another Python is asked for, which has packages of its own."""
    script = format_batch_script(tmp_path / "%j", SlurmOptions(python=python), 1)
    assert ("export PYTHONSAFEPATH=1" in script) == (python is None)


def test_what_sbatch_refuses_is_one_line(tmp_path: Path, cluster: Path):
    (cluster / "sbatch").write_text(
        "#!/bin/sh\necho \"sbatch: unrecognized option '--patition=x'\" >&2; exit 1\n"
    )
    with pytest.raises(InputError, match=r"executor=slurm: .*unrecognized option '--patition=x'") as error:
        Slurm(tmp_path / "logs" / "%j", parse_slurm_options({"time": "60", "patition": "x"})).submit(print)
    assert "\n" not in str(error.value)


def test_a_folder_that_slurm_would_change_is_refused(tmp_path: Path):
    for name in ("p%j", "50%", "a\\b", "a\nb"):
        with pytest.raises(InputError, match="must not contain %"):
            format_batch_script(tmp_path / name / "workers" / "%j", SlurmOptions(), 1)
    script = format_batch_script(tmp_path / "a b $c" / "%j", SlurmOptions(), 1)
    assert f"#SBATCH --output='{tmp_path}/a b $c/%j/%a/log.txt'" in script
