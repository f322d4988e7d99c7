"""`data.mirror` reaches every training: that of the network, of its VQ-VAE, and of the refiner behind it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import tiny
import torch

from memmlp.config.build import build_experiment
from memmlp.config.compose import composed
from memmlp.motion.body import builtin_rest_joints
from memmlp.networks import checkpoint
from memmlp.runs.run import Run
from memmlp.training.run_stages import Experiment

DATA = SimpleNamespace(manifest=SimpleNamespace(rest=builtin_rest_joints()), open=lambda split: tiny.frames())
SHORT = [
    "profile=tiny", "loggers=none", "optim.steps=2", "optim.batch=4", "vqvae.steps=2",
]  # fmt: skip


def experiment(mirror: bool, *overrides: str) -> Experiment:
    return build_experiment(composed([*SHORT, f"data.mirror={mirror}", *overrides]))


def trained(training, architecture, prerequisite: Path | None, folder: Path) -> dict[str, torch.Tensor]:
    folder.mkdir()
    training.train(architecture, DATA, prerequisite, run := Run(folder), torch.device("cpu"))
    return checkpoint.read(run.model)[0]


def differ(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return any(not torch.equal(tensor, other[name]) for name, tensor in one.items())


@pytest.mark.slow
def test_a_vqvae_learns_mirrored_frames_and_is_another_run(tmp_path: Path):
    plain, mirrored = experiment(False), experiment(True)
    made = {
        name: trained(one.prerequisites[0], one.architecture, None, tmp_path / name)
        for name, one in (("plain", plain), ("again", plain), ("mirrored", mirrored))
    }
    assert not differ(made["plain"], made["again"])
    assert differ(made["plain"], made["mirrored"])
    (one, _), (other, _) = (found.identities("d") for found in (plain, mirrored))
    assert one.id != other.id
