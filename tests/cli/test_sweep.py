"""`memmlp sweep` as a person types it, on tiny runs."""

import os
import re
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from command_line import BRIEF, run
from processes import PATIENCE, forked, until

from memmlp.cli.main import main
from memmlp.common.errors import InputError
from memmlp.config.compose_plan import find_sweep, make_plan
from memmlp.config.worker_process import perform_task
from memmlp.runs.lookup import list_runs
from memmlp.runs.run import Run
from memmlp.sweep.progress_table import describe_task

TINY = [*BRIEF, "export.graph=off"]
VARIANTS = {"full": [], "none": ["memory=none"], "wild": ["optim.lr=1e30"]}


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """Run a sweep of three variants, one of which diverges, in a folder of its own."""
    folder = tmp_path_factory.mktemp("sweep")
    write(folder, VARIANTS)
    (folder / "first.txt").write_text(command(folder, "executor=debug", code=1))
    return folder


def write(folder: Path, variants: dict) -> None:
    (folder / "trial.yaml").write_text(yaml.safe_dump({"variants": variants}))


def command(folder: Path, *arguments: str, code: int = 0) -> str:
    return run(folder, "sweep", "trial.yaml", *TINY, *arguments, code=code)


def stamps(folder: Path) -> dict[str, int]:
    return {run.id: run.marker.stat().st_mtime_ns for run in list_runs(folder / "outputs") if run.done}


def test_what_can_be_done_is_done_once(home: Path):
    said = (home / "first.txt").read_text()
    for words in ("3 of 4 runs done", "wild seed 0: failed, loss is nan", "MPJPE"):
        assert words in said
    assert [re.search(rf"^{variant} +(./1)", said, re.M)[1] for variant in VARIANTS] == ["1/1", "1/1", "0/1"]
    runs = list_runs(home / "outputs")
    assert sorted(run.manifest["kind"] for run in runs if run.done) == ["memmlp", "memmlp", "vqvae"]
    assert {(run.manifest["device"], run.manifest["processes"]) for run in runs} == {("cpu", 1)}
    assert "none seed 0: done" in said
    before = stamps(home)
    assert "3 of 4 runs done" in command(home, code=1)
    assert stamps(home) == before


def test_status_and_dry_run_show_and_do_nothing(home: Path):
    before, folders = stamps(home), sorted((home / "outputs" / "sweeps").iterdir())
    said = command(home, "--status")
    assert "3 done, 1 failed" in said
    assert said.startswith(f"overrides: {' '.join(TINY)}")
    assert "has changed since" not in said
    older = next(r for r in list_runs(home / "outputs") if r.config.get("memory", {}).get("name") == "none")
    sources = older.manifest["sources"]
    older.write_manifest({"sources": sources | {"training/loop.py": "0" * 12}})
    assert re.search(r"training/loop.py has changed since.*: 'none'\n", command(home, "--status"))
    older.write_manifest({"sources": sources})
    forecast = command(home, "seed=0,1", "--dry-run", "--workers", "2")
    assert "4 of 8 runs to do, 2 at once: about" in forecast
    words = ("executor=slurm", "slurm.partition=gpu", "slurm.time=10:00:00", "slurm.mem_gb=8")
    slurm = command(home, "--dry-run", *words, "--workers", "3")
    for line in ("array=0-2", "time=10:00:00", "partition=gpu", "mem=8GB"):
        assert f"#SBATCH --{line}" in slurm
    assert "waiting" in command(home, "seed=7", "optim.weight_decay=0.1", "--status")
    assert (stamps(home), sorted((home / "outputs" / "sweeps").iterdir())) == (before, folders)


def test_variants_that_are_named_are_run_alone(home: Path):
    before = stamps(home)
    said = command(home, "seed=0,1", "--variant", "none", "--dry-run", "--workers", "1")
    assert "1 of 2 runs to do" in said
    said = command(home, "--status", "--variant", "none")
    assert "1 done" in said
    assert "wild" not in said
    # The failure of another variant does not count.
    said = command(home, "--variant", "none", "--variant", "full")
    assert "3 of 4 runs done" in said
    assert "repeat failed runs with --retry" in command(home, "--variant", "wild", code=1)
    assert stamps(home) == before


def test_a_first_dry_run_counts_the_runs_whose_data_is_not_prepared(tmp_path: Path):
    (tmp_path / "trial.yaml").write_text("axes: {seed: [5, 6]}")
    said = command(tmp_path, "--dry-run", "--workers", "2")
    assert "2 runs need data that is not prepared yet; the sweep prepares it first" in said
    assert "2 of 2 runs to do, and VQ-VAEs that these runs need, 2 at once" in said
    assert not list_runs(tmp_path / "outputs")


def test_seeds_come_one_after_another_each_with_all_variants(home: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(home)
    outputs = (home / "outputs").absolute()
    plan = make_plan(find_sweep("trial.yaml").with_overrides([*TINY, "seed=1,0"]), outputs)
    cells = [(entry.seed, entry.label) for entry in plan.entries]
    assert cells == [(seed, variant) for seed in (1, 0) for variant in VARIANTS]
    assert [task.id for task in plan.tasks if task.kind == "memmlp"] == [entry.id for entry in plan.entries]
    for number, task in enumerate(plan.tasks):
        assert task.prerequisite in (None, *(other.id for other in plan.tasks[:number]))
    codes = plan.tasks[0]
    assert describe_task(plan, codes).startswith(f"VQ-VAE {codes.id} of seed ")
    said = command(home, "seed=1,0", "--status")
    assert re.search(r"variant +seed 0 +seed 1", said)
    assert re.search(r"none +[\d.]+ cm +waiting", said)


def test_retry_takes_failed_runs_up_again(home: Path):
    failed = next(run for run in list_runs(home / "outputs") if run.failure)
    attempts = len(failed.manifest["attempts"])
    assert "3 of 4 runs done" in command(home, "--retry", "executor=debug", code=1)
    assert len(Run(failed.folder).manifest["attempts"]) == attempts + 1
    assert failed.failure is not None


def test_again_does_networks_again_and_force_is_refused(home: Path, tmp_path: Path, monkeypatch):
    """With force=true two variants that share a run would make each other's stages again and again."""
    copy = Path(shutil.copytree(home, tmp_path / "copy"))
    left = []
    monkeypatch.setattr(
        "memmlp.cli.sweep.run_workers", lambda chosen, plan, workers: left.extend(plan.list_remaining())
    )
    command(copy, "--again")
    assert sorted(task.kind for task in left) == ["memmlp", "memmlp", "memmlp"]
    kinds = {run.manifest.get("kind") for run in list_runs(copy / "outputs") if run.done}
    assert kinds == {"vqvae"}
    assert "--again: " in command(copy, "--again", "--status", code=2)
    assert "force=true: " in command(copy, "force=true", code=2)


def test_a_look_at_other_seeds_or_without_the_data_leaves_a_sweep_as_it_was(home, tmp_path, monkeypatch):
    """Its runs must not look orphaned, which `memmlp runs gc` deletes."""
    copy = Path(shutil.copytree(home, tmp_path / "copy"))
    monkeypatch.chdir(copy)
    assert "1 waiting" not in command(copy, "executor=debug", code=1)
    folder = next((copy / "outputs" / "sweeps").glob("trial-*"))
    before = {path.name: path.read_bytes() for path in folder.glob("*.json")}
    assert "waiting" in command(copy, "seed=7", "--status")
    command(copy, "seed=7", "--dry-run")
    assert "0/1" in run(copy, "table", "trial.yaml", *TINY, "seed=7")
    shutil.move(copy / "outputs" / "data", copy / "elsewhere")
    command(copy, "--status")
    assert {path.name: path.read_bytes() for path in folder.glob("*.json")} == before
    assert "orphaned" not in run(copy, "runs", "gc")


def as_typed(folder: Path, *arguments: str) -> None:
    """What `processes.forked` does for a command line that is the whole process, which hears Ctrl-C."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(folder)
    sys.argv = ["memmlp", *arguments]
    main()


@pytest.mark.slow
def test_an_interrupted_sweep_ends_its_workers(tmp_path: Path):
    """By a scheduler's signal, which is handled as Ctrl-C is."""
    write(tmp_path, {"none": ["memory=none"]})
    file = tmp_path / "said.txt"
    file.touch()
    words = ("sweep", "trial.yaml", *TINY, "optim.steps=100000", "--workers", "1")
    with forked(as_typed, tmp_path, *words, said=str(file)) as process:
        begun = lambda: any(run.step for run in list_runs(tmp_path / "outputs"))  # noqa: E731
        until(begun, "the run's first steps", process)
        run = list_runs(tmp_path / "outputs")[0]
        assert run.activity
        os.kill(process.pid, signal.SIGTERM)
        left, said = process.wait(PATIENCE), file.read_text()
    assert left == 130, said
    assert "interrupted" in said
    assert "Traceback" not in said
    until(lambda: run.status in ("interrupted", "lost"), "its worker ends")


BAD_INPUT: list[tuple[list[str], str]] = [
    (["nosuch"], "sweep 'nosuch': no such sweep"), (["missing.yaml"], "missing.yaml: no such file"),
    (["trial.yaml", "memory=nosuch"], "memory=nosuch"),
    (["trial.yaml", "--variant", "non"], "sweep trial: no variant 'non'"),
    (["trial.yaml", "--variant", "none", "--until-decided"], "--variant: "),
    (["trial.yaml", "executor=cloud"], "executor=cloud: "),
    (["trial.yaml", "slurm.partition=x"], "slurm.partition: needs executor=slurm"),
    (["trial.yaml", "executor=slurm", "slurm.nodes=2"], "slurm.nodes: "),
    (["trial.yaml", "executor=slurm", "--gpus-per-worker", "1"], "--gpus-per-worker: "),
    (["trial.yaml", "device=cuda:x"], "device=cuda:x: "), (["trial.yaml", "seed=a"], "seed: ['a']"),
    (["trial.yaml", "data=mocap"], "variant 'full': data.root: has no value"),
    (["solved.yaml"], "variant 'b': branch: combined needs evaluation.ik=lbfgs"),
]  # fmt: skip


def test_bad_input_is_one_line(tmp_path: Path):
    write(tmp_path, VARIANTS)
    solved = "branch: combined\nvariants: {a: [evaluation.ik=arms], b: []}\n"
    (tmp_path / "solved.yaml").write_text(solved)
    for words, line in BAD_INPUT:
        said = run(tmp_path, "sweep", *words, code=2)
        assert line in said, words
        assert said.count("\n") == 1


def test_shipped_sweeps_are_found_by_name_and_number():
    names = {"14": "table14", "table14": "table14", "04": "table04", "4": "table04", "mix": "mix"}
    assert {name: find_sweep(name).name for name in names} == names


def test_a_worker_of_other_code_or_data_leaves_the_run_alone(home: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(home)
    plan = make_plan(find_sweep("trial.yaml").with_overrides(TINY), (home / "outputs").absolute())
    other = replace(next(task for task in plan.tasks if task.kind == "memmlp"), id="0" * 16)
    with pytest.raises(InputError, match="the data or the code has changed"):
        perform_task(home / "plan.json", 1, plan, other)
    assert not plan.get_run(other).folder.exists()
