"""Processes killed at arbitrary moments: a training, a sweep and a search end as undisturbed ones do."""

import json
import random
import shutil
import signal
from collections.abc import Sequence
from pathlib import Path

import pytest
from command_line import BRIEF, SMALL, in_folder, run
from processes import Forked, forked, until

from benchmarks import chaos, nasty_names
from memmlp.common.lease import current_process
from memmlp.networks import checkpoint
from memmlp.runs.lookup import list_runs
from memmlp.runs.run import Run


def last_step(outputs: Path) -> int:
    runs = [run for run in list_runs(outputs) if run.manifest.get("kind") == "memmlp"]
    files = [run.checkpoint for run in runs if run.checkpoint.exists()]
    return max((int(checkpoint.read(file)[1]["step"]) for file in files), default=0)


FREQUENT = ["evaluation.modes=[stream]", "optim.checkpoint_every=5"]
MOMENTS = {
    "the VQ-VAE is there, and no checkpoint": lambda outputs: list(outputs.glob("runs/*/DONE")),
    "the network is trained further": lambda outputs: last_step(outputs) >= 10,
}


@pytest.mark.slow
def test_a_killed_training_resumes_to_the_same_model(tmp_path: Path):
    words = ["train", *BRIEF, "optim.steps=20", *FREQUENT, "export.graph=off"]
    disturbed, whole = tmp_path / "disturbed", tmp_path / "whole"
    for folder in (disturbed, whole):
        folder.mkdir()
    for name, reached in MOMENTS.items():
        with forked(in_folder, disturbed, *words) as process:
            until(lambda reached=reached: reached(disturbed / "outputs"), name, process)
            process.kill()
            assert process.wait() == -signal.SIGKILL
    for folder in (disturbed, whole):
        run(folder, *words)
    (expected,) = (made for made in list_runs(whole / "outputs") if "stream" in made.results)
    killed = Run.from_id(disturbed / "outputs", expected.id)
    assert killed.done
    assert killed.model.read_bytes() == expected.model.read_bytes()
    rotation = killed.results["stream"]["rotation"]
    assert rotation == pytest.approx(expected.results["stream"]["rotation"], rel=1e-6)


def fork_controllers(folder: Path, monkeypatch: pytest.MonkeyPatch, *workers: str) -> None:
    """Controllers are forked, which saves the import of torch."""

    def start(words: Sequence[str], outputs: Path, **_: int) -> Forked:
        return Forked(in_folder, folder, *words, *workers, "--outputs", str(outputs))

    monkeypatch.setattr(chaos, "start", start)


@pytest.mark.long
@pytest.mark.parametrize("during", ["anything", "checkpoints", "evaluation", "export"])
def test_a_sweep_under_kills_ends_as_an_undisturbed_one(tmp_path: Path, monkeypatch, during: str):
    fork_controllers(tmp_path, monkeypatch, "executor=debug")
    words, controllers = [*SMALL, *FREQUENT], 1
    if during == "anything":
        words, controllers = [*words, "export.graph=off"], 2
    else:
        monkeypatch.setattr(chaos, "PAUSES", (0.05, 0.3))
    assert chaos.sweep_storm(2, 2, controllers, random.Random(0), words, during) == []


@pytest.mark.long
def test_a_search_under_kills_has_every_trial_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    fork_controllers(tmp_path, monkeypatch, "--workers", "1")
    assert chaos.search_storm(2, 1, 1, random.Random(0), SMALL) == []


@pytest.mark.long
def test_nasty_names_pass_through_all_commands():
    pytest.importorskip("mlflow")
    assert nasty_names.find_problems(3, random.Random(0)) == []


def finished(outputs: Path, name: str, weights: bytes = b"w") -> Run:
    run = Run.from_id(outputs, name * 16)
    run.begin("memmlp", {}, data="d", prerequisite=None)
    run.request_stages([])  # no evaluation and no export
    run.model.write_bytes(weights)
    run.finish(["model.safetensors"])
    return run


def test_every_kind_of_difference_is_found(tmp_path: Path):
    calm, stormy = tmp_path / "calm", tmp_path / "stormy"
    for name in "abcde0":
        finished(calm, name)
    shutil.copytree(calm, stormy)
    assert chaos.compare(calm, stormy) == []
    shutil.rmtree(Run.from_id(stormy, "a" * 16).folder)
    finished(stormy, "f")
    finished(stormy, "b", b"other")
    Run.from_id(stormy, "c" * 16).marker.unlink()
    claim = {**current_process(), "since": "now"}
    (Run.from_id(stormy, "d" * 16).folder / ".lease-1").write_text(json.dumps(claim))
    Run.from_id(stormy, "e" * 16).model.write_bytes(b"damaged")
    again = {"started": "2999-01-01T00:00:00+00:00", "stage": "training"}
    Run.from_id(stormy, "0" * 16).write_manifest({"attempts": [again]})
    assert sorted(chaos.compare(calm, stormy)) == [
        f"run {'0' * 16}: trained again after it was finished", f"run {'a' * 16} is missing",
        f"run {'b' * 16}: other weights", f"run {'c' * 16}: interrupted, not done",
        f"run {'d' * 16}: is still held", f"run {'e' * 16}: artifact model.safetensors is missing or changed",
        f"run {'e' * 16}: other weights", f"run {'f' * 16} should not be",
    ]  # fmt: skip
