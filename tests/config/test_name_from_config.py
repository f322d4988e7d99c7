"""Names say what differs from the default, whatever Hydra is busy with."""

from typing import Any

import pytest
from omegaconf import OmegaConf

from memmlp.config.compose import compose_config
from memmlp.config.name_from_config import make_readable_name

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


def test_many_differences_are_counted():
    words = [f"optim.{key}" for key in ("lr=0.02", "steps=9", "batch=3", "weight_decay=0.5", "clip_norm=2")]
    found = name(*words, "memory=none", "predictor=rotation_only", "hand=off")
    assert found.endswith(" · 2 more · seed 0")


def test_a_vqvae_and_a_component_of_ones_own():
    whole = config()
    codes = {"normalizer": whole["normalizer"], "vqvae": whole["vqvae"] | {"codes": 9, "seed": 4}}
    assert make_readable_name("vqvae", codes) == "VQ-VAE · vqvae.codes=9 · seed 4"
    mine = whole | {"memory": {"name": "mine", "knob": 3}}
    assert make_readable_name("memmlp", mine) == "memory=mine · seed 0"
