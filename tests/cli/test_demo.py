"""`memmlp demo` says what it does where no terminal shows progress bars."""

import sys
from pathlib import Path

import pytest
from command_line import BRIEF

from memmlp.cli.demo import describe_next_steps, find_inactive_environment, is_valid_for_recurrent_poser


@pytest.mark.slow
def test_two_networks_side_by_side(memmlp):
    ran = memmlp("demo", *BRIEF, "evaluation.modes=[stream]", "export.graph=off")
    assert ran.code == 0
    stages = [line.partition(":")[0] for line in ran.err.splitlines()]  # without a terminal for bars
    assert stages == ["data", "VQ-VAE", "network", "evaluation", "data", "network", "evaluation"]
    heads = [line.split() for line in ran.out.splitlines()]
    first = heads.index(["Mem-MLP", "Mem-MLP"])
    assert heads[first + 1] == ["metric", "unit", "rotation", "position", "RecurrentPoser"]
    assert "the demo took" in ran.out
    assert "--label Mem-MLP --label RecurrentPoser" in ran.out.partition("next: ")[2]


def test_overrides_that_recurrent_poser_cannot_take_are_known_before_training():
    assert is_valid_for_recurrent_poser(["vqvae.steps=7", "optim.steps=500"])
    for words in (
        ["memory=none"], ["evaluation.ik=lbfgs"], ["model=avatar_poser"], ["experiment=no_memory"],
    ):  # fmt: skip
        assert not is_valid_for_recurrent_poser(words), words


def test_next_steps_enter_the_environment_and_repeat_the_overrides(tmp_path: Path, monkeypatch):
    folder = tmp_path / ".venv"
    (folder / "bin").mkdir(parents=True)
    for name in ("activate", "memmlp"):
        (folder / "bin" / name).touch(mode=0o755)
    monkeypatch.setattr(sys, "prefix", str(folder))
    monkeypatch.setenv("PATH", "")
    assert find_inactive_environment() == folder
    enter, first, _, own = describe_next_steps(["profile=tiny", "seed=1", "threads=1"], folder).splitlines()
    assert enter == f"next: source {folder}/bin/activate"
    assert first.split()[:6] == ["memmlp", "train", "profile=tiny", "seed=1", "threads=1", "memory=none"]
    data = ["data=mocap", "data.root=outputs/data/mine"]
    assert own.split() == ["memmlp", "train", "profile=tiny", "threads=1", *data]
    monkeypatch.setenv("PATH", str(folder / "bin"))
    assert find_inactive_environment() is None
