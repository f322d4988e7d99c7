"""Slurm by its sbatch file, and by a stand-in for its commands."""

from functools import partial
from pathlib import Path

import pytest

from memmlp.common.errors import InputError
from memmlp.sweep.executors.slurm import (
    RequeuedWork,
    Slurm,
    SlurmOptions,
    format_batch_script,
    parse_slurm_options,
)


def lines(tmp_path: Path, **words: str) -> list[str]:
    options = parse_slurm_options({"time": "60", **words})
    return format_batch_script(tmp_path / "%j", options, 1).splitlines()


def test_options_reach_sbatch(tmp_path: Path):
    words = {"time": "600", "mem_gb": "16", "cpus": "4", "gpus": "1", "partition": "gpu", "account": "lab"}
    words |= {"setup": "module load cuda", "mail-user": "me@lab.org", "exclusive": "true", "gres": "disk:1"}
    found = lines(tmp_path, **words, overcommit="false")
    for line in (
        "time=600", "mem=16GB", "cpus-per-task=4", "gpus-per-node=1", "partition=gpu", "account=lab",
        "mail-user=me@lab.org", "exclusive", "gres=disk:1", "job-name=memmlp", "signal=USR2@90",
    ):  # fmt: skip
        assert f"#SBATCH --{line}" in found
    assert "module load cuda" in found
    assert f"submitit.core._submit {tmp_path}/%j" in "\n".join(found)
    assert "overcommit" not in "\n".join(found)


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
    assert " python3 -u -m submitit" in command
    assert not [line for line in found if line.startswith("#SBATCH --container")]


def test_bad_options_are_one_line():
    for settings, line in (
        ({"time": "1h"}, "slurm.time=1h: expected MINUTES"), ({"comment": "a\nb"}, "expected the long name"),
        ({"cpus": "0"}, "slurm.cpus=0"), ({"array": "0-3"}, "set by memmlp"),
        ({"mem_gb": "x"}, "slurm.mem_gb=x"),
        ({"gpus": "-1"}, "slurm.gpus=-1"), ({"nodes": "2"}, "slurm.nodes: cannot be set"),
        ({"ntasks-per-node": "2"}, "cannot be set"), ({"Q": "x"}, "expected the long name"),
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
    """Slurm's commands, of which sbatch keeps the files that it is given."""
    folder = tmp_path / "bin"
    folder.mkdir()
    keep = f'cp "$1" {folder}/given.sh; env > {folder}/given.env; echo "x" >> {folder}/calls'
    keep += '; echo "Submitted batch job 42"'
    for name, line in {"sbatch": keep, "srun": "true", "sacct": "true"}.items():
        (folder / name).write_text(f"#!/bin/sh\n{line}\n")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(folder), prepend=":")
    return folder


def test_workers_are_submitted_at_once(tmp_path: Path, cluster: Path):
    slurm = Slurm(tmp_path / "logs" / "%j", parse_slurm_options({"gpus": "1", "time": "1-0"}))
    handles = slurm.submit(partial(print, "work"), 3)
    assert slurm.gpus
    assert [handle.job.job_id for handle in handles] == ["42_0", "42_1", "42_2"]
    assert (cluster / "calls").read_text() == "x\n"
    given = (cluster / "given.sh").read_text()
    assert "#SBATCH --array=0-2%3" in given
    assert "#SBATCH --time=1-0" in given
    assert "wckey" not in given


@pytest.mark.parametrize("python", [None, "srun python3"])
def test_jobs_import_the_package_that_submits_them(tmp_path: Path, cluster: Path, python: str | None):
    """Unless another Python is asked for, which has packages of its own."""
    Slurm(tmp_path / "logs" / "%j", SlurmOptions(python=python)).submit(partial(print, "work"))
    given = (cluster / "given.env").read_text().splitlines()
    assert ("PYTHONSAFEPATH=1" in given) == (python is None)


def test_what_sbatch_refuses_is_one_line(tmp_path: Path, cluster: Path):
    (cluster / "sbatch").write_text(
        "#!/bin/sh\necho \"sbatch: unrecognized option '--patition=x'\" >&2; exit 1\n"
    )
    with pytest.raises(InputError, match=r"executor=slurm: .*unrecognized option '--patition=x'") as error:
        Slurm(tmp_path / "logs" / "%j", parse_slurm_options({"time": "60", "patition": "x"})).submit(print)
    assert "\n" not in str(error.value)


def test_preempted_work_is_queued_again(tmp_path: Path):
    work = RequeuedWork(partial((tmp_path / "again").write_text, "done"))
    work.checkpoint().function()
    assert (tmp_path / "again").exists()


def test_a_folder_that_slurm_would_change_is_refused(tmp_path: Path):
    for name in ("p%j", "50%", "a\\b", "a\nb"):
        with pytest.raises(InputError, match="must not contain %"):
            format_batch_script(tmp_path / name / "workers" / "%j", SlurmOptions(), 1)
    script = format_batch_script(tmp_path / "a b $c" / "%j", SlurmOptions(), 1)
    assert f"#SBATCH --output='{tmp_path}/a b $c/%j/%j_0_log.out'" in script
