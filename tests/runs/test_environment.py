"""What a run records of where it ran."""

import json
import platform
import subprocess
from pathlib import Path

import pytest

from memmlp.common.files import file_digest
from memmlp.runs import environment as module
from memmlp.runs.environment import (
    collect_prerequisite_versions,
    describe_environment,
    describe_user_packages,
    list_prerequisite_origins,
)
from memmlp.runs.run import Run


def test_environment_says_what_ran_without_the_machines_name():
    found = describe_environment()
    assert {"version", "git", "python", "packages", "platform", "cpu", "cores", "host"} == set(found)
    assert found["packages"]["torch"].startswith("2.")
    assert platform.node() not in json.dumps(found)


def test_code_that_is_edited_while_it_runs_is_recorded_as_it_runs(tmp_path: Path, monkeypatch):
    """A worker does many runs with what it imported, whatever its files say later."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "lab_of_mine.py").write_text("A = 1\n")
    before = describe_user_packages(["lab_of_mine"])
    (tmp_path / "lab_of_mine.py").write_text("A = 2\n")
    assert describe_user_packages(["lab_of_mine"]) == before


def test_a_patch_is_of_the_code_that_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "first"]):
        (tmp_path / "__init__.py").write_text("A = 1\n")
        author = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
        subprocess.run(["git", "-C", str(tmp_path), *author, *words], check=True)
    monkeypatch.setattr(module, "PACKAGE", tmp_path)
    cached = (module._describe_commit, module.create_code_patch)
    try:
        for one in cached:
            one.cache_clear()
        (tmp_path / "__init__.py").write_text("A = 2\n")
        patch = module.create_code_patch()
        assert "+A = 2" in patch
        (tmp_path / "__init__.py").write_text("A = 3\n")
        assert module.create_code_patch() == patch
    finally:
        for one in cached:
            one.cache_clear()


CODES, PART, NETWORK = (letter * 16 for letter in "abc")


def trained(outputs: Path, name: str, prerequisite: Run | None = None, weights: str = "w", **facts) -> Run:
    run = Run.from_id(outputs, name)
    if prerequisite:
        origins = list_prerequisite_origins(prerequisite.manifest, prerequisite.weights_digest)
        facts |= {"prerequisite_runs": origins}
    run.begin("vqvae", {}, data="d", prerequisite=prerequisite.id if prerequisite else None, **facts)
    run.model.write_text(weights)
    run.finish([run.model.name])
    return run


def test_what_a_run_builds_upon_stays_known_when_that_is_trained_again(tmp_path: Path):
    """Its id says how it is trained, and not which weights came of it."""
    codes = trained(tmp_path, CODES, component_versions={"vqvae": 1}, gpu="A card", device="cuda")
    network = trained(tmp_path, NETWORK, codes)
    digest, before = file_digest(codes.model), network.manifest["prerequisite_runs"]
    codes.reset()
    others = trained(tmp_path, CODES, weights="others")
    assert list_prerequisite_origins(others.manifest, others.weights_digest)[0]["weights"] != digest
    (found,) = network.manifest["prerequisite_runs"]
    assert [found] == before
    assert (found["id"], found["kind"], found["weights"]) == (CODES, "vqvae", digest)
    assert (found["component_versions"], found["gpu"], found["device"]) == ({"vqvae": 1}, "A card", "cuda")
    assert {"git", "sources", "cpu", "packages"} <= found.keys()


def test_prerequisites_of_prerequisites_are_known(tmp_path: Path):
    codes = trained(tmp_path, CODES, component_versions={"vqvae": 1})
    part = trained(tmp_path, PART, codes, component_versions={"model.mem_mlp": 2})
    network = trained(tmp_path, NETWORK, part)
    assert [one["id"] for one in network.manifest["prerequisite_runs"]] == [PART, CODES]
    assert collect_prerequisite_versions(network.manifest) == {"vqvae": 1, "model.mem_mlp": 2}


def test_a_training_that_is_resumed_elsewhere_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    run = Run.from_id(tmp_path, "0" * 16)

    def begin(device: str, commit: str, dirty: bool, losses: str) -> dict:
        made = {"git": {"commit": commit, "dirty": dirty}, "cpu": "A"}
        monkeypatch.setattr("memmlp.runs.run.describe_environment", lambda: made)
        files = {"losses.py": losses.encode(), "ik.py": b"i"}
        monkeypatch.setattr("memmlp.runs.environment.read_code_files", lambda packages: files)
        run.begin("memmlp", {}, data="d", prerequisite=None, device=device, threads=2)
        return run.manifest

    begin("cuda:0", "a" * 40, True, "old")
    assert begin("cpu", "b" * 40, False, "new")["device"] == "cpu"  # nothing was trained before
    run.checkpoint.touch()
    found = begin("cuda:0", "c" * 40, False, "newer")
    assert (found["device"], found["threads"], found["cpu"]) == ("cpu, cuda:0", 2, "A")
    assert found["git"] == {"commit": "c" * 40, "dirty": False, "before": "b" * 40}
    assert run.changed_sources == ["losses.py"]
