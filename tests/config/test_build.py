"""Every option of every group trains, streams and differs from its base; every kind of graph exports."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from memmlp.common.errors import InputError
from memmlp.config.build import build_experiment, list_overrides, make_readable_name
from memmlp.config.compose import compose_config
from memmlp.runs.identity import select_training_config
from memmlp.training.run_stages import Experiment

TINY = [
    "profile=tiny", "data.synth.minutes=0.1", "loggers=none", "threads=1", "optim.steps=2", "vqvae.steps=2",
    "optim.batch=4", "model.width=8", "memory.width=4", "vqvae.width=8", "evaluation.ik_iterations=2",
]  # fmt: skip


@pytest.mark.slow
def test_a_joint_vqvae_is_part_of_the_runs_identity_and_its_own_stage_is_not():
    def experiment_of(*overrides: str) -> Experiment:
        return build_experiment(compose_config(["memory=vq_joint", *overrides]))

    def identity(*overrides: str) -> str:
        return experiment_of(*overrides).identity("data").id

    base = identity()
    assert all(identity(change) != base for change in ("vqvae.codes=32", "vqvae.encoder_depth=2"))
    assert all(identity(change) == base for change in ("vqvae.steps=7", "vqvae.lr=0.5", "loggers=none"))
    assert experiment_of().compute_identities("data") == [experiment_of().identity("data")]


def test_a_refiner_has_a_rate_of_its_own_and_its_network_keeps_its():
    words = [*TINY, "refiner=sage", "optim.lr=4e-3", "optim.final_lr=4e-4"]
    plain, own = (build_experiment(compose_config([*words, *more])) for more in ([], ["refiner.lr=1e-3"]))
    assert plain.training.optim.lr == 4e-3
    assert (own.training.optim.lr, own.training.optim.final_lr) == (1e-3, pytest.approx(1e-4))
    assert own.unrefined.training.optim.lr == 4e-3


pytestmark = pytest.mark.slow


def config(*words: str) -> dict[str, Any]:
    found: Any = OmegaConf.to_container(compose_config(list(words)), resolve=True)
    return found


def name(*words: str) -> str:
    return make_readable_name("memmlp", config(*words))


@pytest.mark.parametrize(("words", "expected"), [
    ("seed=1", "default · seed 1"),
    ("memory=gru seed=1", "memory=gru · seed 1"),
    ("memory=gru memory.layers=[2]", "memory=gru · memory.layers=[2] · seed 0"),
    ("model=bodiffusion", "model=bodiffusion · seed 0"),
    ("model=bodiffusion optim.ema=null", "model=bodiffusion · optim.ema=null · seed 0"),
    ("profile=paper optim.lr=0.01", "profile=paper · optim.lr=0.01 · seed 0"),
    ("profile.width=64", "profile.width=64 · seed 0"),
    ("data.drawn_by=clips device=cpu threads=1 loggers=none evaluation.modes=[window]",
     "data.drawn_by=clips · seed 0"),
])  # fmt: skip
def test_what_differs(words: str, expected: str):
    assert name(*words.split()) == expected


def test_a_vqvae_and_a_component_of_ones_own():
    whole = config()
    codes = {"normalizer": whole["normalizer"], "vqvae": whole["vqvae"] | {"codes": 9, "seed": 4}}
    assert make_readable_name("vqvae", codes) == "VQ-VAE · vqvae.codes=9 · seed 4"
    mine = whole | {"memory": {"name": "mine", "knob": 3}}
    assert make_readable_name("memmlp", mine) == "memory=mine · seed 0"


@pytest.mark.parametrize("data", ["synth", "mocap"])
def test_the_overrides_of_a_recorded_config_compose_it_again(tmp_path: Path, data: str):
    (tmp_path / "take.npz").touch()
    values = ["profile=tiny", "memory=gru", "seed=3", "vqvae.seed=0", "optim.lr=0.0123"]
    given = [f"data={data}", f"data.root={tmp_path}", *values]
    config = OmegaConf.to_container(compose_config(given), resolve=True)
    words = list_overrides(config)
    assert set(values) <= set(words)
    again = OmegaConf.to_container(compose_config(words), resolve=True)
    assert select_training_config(again) == select_training_config(config)
    with pytest.raises(InputError, match="model: is not in the run's config"):
        list_overrides({"data": {"name": "synth"}})
