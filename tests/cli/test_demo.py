"""`memmlp demo` says what it does where no terminal shows progress bars."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from command_line import TINY

from memmlp.cli.demo import describe_next_steps, find_inactive_environment, is_valid_for_recurrent_poser


@pytest.mark.slow
def test_each_stage_has_a_line_without_a_terminal(memmlp):
    ran = memmlp("demo", *TINY, "data.synth.minutes=0.1", "evaluation.modes=[stream]")
    assert ran.code == 0
    stages = [line.partition(":")[0] for line in ran.err.splitlines()]
    again = ["data", "network", "evaluation", "deployment"]
    assert stages == ["data", "VQ-VAE", "network", "evaluation", "deployment", *again]
    heads = [line.split() for line in ran.out.splitlines()]
    first = next(number for number, words in enumerate(heads) if "Mem-MLP" in words)
    assert heads[first] == ["Mem-MLP", "Mem-MLP"]
    assert heads[first + 1] == ["metric", "unit", "rotation", "position", "RecurrentPoser"]
    assert "the demo took" in ran.out
    assert "--label Mem-MLP --label RecurrentPoser" in ran.out.partition("next: ")[2]


@pytest.mark.slow
def test_an_override_of_mem_mlps_slots_shows_it_alone(memmlp):
    ran = memmlp("demo", *TINY, "memory=none", "evaluation.modes=[stream]", "export.graph=off")
    assert (ran.code, ran.out.count("run      ")) == (0, 1)
    assert "side by side" not in ran.out


def test_overrides_that_recurrent_poser_cannot_take_are_known_before_training():
    for words in (["profile=tiny", "threads=1"], ["vqvae.steps=7", "optim.steps=500"]):
        assert is_valid_for_recurrent_poser(words)
    for words in (
        ["memory=none"],
        ["evaluation.ik=lbfgs"],
        ["predictor=rotation_only", "hand=off"],
        ["model=avatar_poser"],
        ["experiment=no_memory"],
    ):
        assert not is_valid_for_recurrent_poser(words), words


def test_next_steps_enter_the_environment_and_repeat_the_overrides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = tmp_path / ".venv"
    (folder / "bin").mkdir(parents=True)
    for name in ("activate", "memmlp"):
        (folder / "bin" / name).touch(mode=0o755)
    monkeypatch.setattr(sys, "prefix", str(folder))
    monkeypatch.setenv("PATH", "")
    found = find_inactive_environment()
    assert found == folder
    assert describe_next_steps([], found).startswith(f"next: source {folder}/bin/activate\n")
    first, imported, own = describe_next_steps(["profile=tiny", "seed=1", "threads=1"]).splitlines()
    assert first.startswith("next: memmlp train profile=tiny seed=1 threads=1 memory=none ")
    assert "memmlp data import" in imported
    data = ["data=mocap", "data.root=outputs/data/mine"]
    assert own.split() == ["memmlp", "train", "profile=tiny", "threads=1", *data]
    monkeypatch.setenv("PATH", str(folder / "bin"))
    assert find_inactive_environment() is None
