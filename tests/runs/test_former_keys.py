"""Keys that had other names: old records are read with today's, ids are made of theirs, users are told."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from memmlp.common.errors import InputError
from memmlp.config.compose import composed
from memmlp.runs.former_keys import (
    KINDS,
    RENAMED,
    present_key,
    with_former_keys,
    with_former_names,
    with_present_keys,
    with_present_names,
)
from memmlp.runs.identity import flatten, run_id

FORMER = {
    "seed": 0,
    "frame": {"coordinates": "heading", "normalize": True},
    "loss": {"name": "manual", "rotation": 2.0, "rotation_velocity": 30.0, "position": 0.5, "velocity": 0.1},
    "model": {"name": "hmd_poser", "layers": 3, "shape": 0.1},
    "data": {"weighting": "clips", "mirror": False},
}
NOW = {
    "seed": 0,
    "normalizer": {"coordinates": "heading", "z_scores": True},
    "loss": {
        "name": "manual", "rotation_all": 2.0, "rotation_velocity": 30.0, "position_branch": 0.5,
        "velocity_lower_body": 0.1,
    },
    "model": {"name": "hmd_poser", "encoder_layers": 3, "shape_weight": 0.1},
    "data": {"drawn_by": "clips", "mirror": False},
}  # fmt: skip


def test_a_recorded_config_is_read_with_the_names_of_today():
    assert with_present_names(FORMER) == NOW
    assert with_present_names(NOW) == NOW
    assert with_present_names({}) == {}


def test_names_come_and_go():
    assert with_former_names(flatten(NOW)) == flatten(FORMER)


@pytest.mark.parametrize("name", ["avatar_poser", "mine"])
def test_the_same_word_of_another_option_stays(name: str):
    loss = {"name": name, "rotation": 1.0, "position": 2.0, "velocity": 3.0}
    assert with_present_names({"loss": loss}) == {"loss": loss}
    assert with_former_names(flatten({"loss": loss})) == flatten({"loss": loss})


def test_a_key_of_a_part_is_found_below_its_group():
    recorded = {"upstream": {"upper_codes": {"drops": [0.5], "drop": 0.2}, "name": "sage"}}
    now = {"upstream": {"upper_codes": {"lr_drops_at": [0.5], "lr_drop": 0.2}, "name": "sage"}}
    assert with_present_names(recorded) == now
    assert with_former_names(flatten(now)) == flatten(recorded)


def test_an_option_has_its_present_name():
    assert with_present_names({"loss": {"name": "own"}}) == {"loss": {"name": "of_network"}}
    assert with_former_names({"loss.name": "of_network"}) == {"loss.name": "own"}
    assert with_present_keys(["loss=own"]) == ("loss=of_network",)


def test_an_id_is_that_of_the_former_names():
    """What version 0.2 made of this config, computed with its code (commit ae007ecb)."""
    made = run_id("memmlp", NOW | {"data": {"drawn_by": "clips"}}, data="d", upstream=None)
    assert made == "30bd7460c64ebd85"


def test_recorded_overrides_have_the_names_of_today():
    words = [
        "model=bodiffusion",
        "model.noise=0.5",
        "frame.normalize=false",
        "frame=default",
        "loss.rotation=1",
    ]
    assert with_present_keys(words) == (
        "model=bodiffusion", "model.noise_weight=0.5", "normalizer.z_scores=false", "normalizer=default",
        "loss.rotation=1",
    )  # fmt: skip
    assert with_present_keys(["loss=manual", "loss.velocity=1"])[1] == "loss.velocity_lower_body=1"
    assert with_present_keys(["model=sage", "model.noise=1"])[1] == "model.noise=1"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["frame.coordinates=world"], "it is now normalizer"),
        (["frame=default"], "it is now normalizer"),
        (["normalizer.normalize=false"], "normalizer.normalize: no such key; it is now normalizer.z_scores"),
        (["loss=manual", "loss.rotation=2"], "loss.rotation: no such key; it is now loss.rotation_all"),
        (["model=bodiffusion", "model.noise=2"], "model.noise: no such key; it is now model.noise_weight"),
        (["data.weighting=clips"], "data.weighting: no such key; it is now data.drawn_by"),
        (
            ["model=sage", "upstream.decoder.drop=1"],
            "upstream.decoder.drop: no such key; it is now upstream.decoder.lr_drop",
        ),
        (["tracking=none"], "tracking=none: no such group; it is now loggers"),
        (["loss=own"], "loss=own: no such option; it is now of_network"),
    ],
)
def test_a_former_name_on_the_command_line_is_answered_with_todays(words: list[str], said: str):
    with pytest.raises(InputError) as error:
        composed(words)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


CONF = Path(__file__).parents[2] / "conf"


def _schema(loss: str) -> str:
    """Return the name under which a config of a loss, or one that it extends, has its schema."""
    first = yaml.safe_load((CONF / "loss" / f"{loss}.yaml").read_text())["defaults"][0]
    found = re.fullmatch(r"/schema/loss_(\w+)@_here_", first)
    return found[1] if found else _schema(first)


def test_the_losses_that_options_bring_are_those_of_the_configs():
    losses = {path.stem: _schema(path.stem) for path in (CONF / "loss").glob("*.yaml")}
    brought = {f"loss={name}": kind for name, kind in losses.items()}
    for path in (CONF / "model").glob("*.yaml"):
        entries = yaml.safe_load(path.read_text())["defaults"]
        loss = next((one["override /loss"] for one in entries if "override /loss" in one), None)
        brought |= {f"model={path.stem}": losses[loss]} if loss else {}
    renamed = {one.option for one in RENAMED}
    differ = {word: kind for word, kind in brought.items() if kind != word.partition("=")[2]}
    assert {word: kind for word, kind in differ.items() if f"loss={kind}" in renamed} | {
        "model=rpm": "rpm"
    } == KINDS


@pytest.mark.parametrize(
    ("chosen", "now"),
    [
        (("loss=kinematic",), "position_from_pelvis"),
        (("model=vae_hmd",), "position_from_pelvis"),
        (("model=rpm",), "world_position"),
        (("model=rpm", "loss=calm"), "position_from_pelvis"),
        (("loss=manual", "model=rpm"), "position_branch"),
        (("model=avatar_poser",), "position"),
        (("model=vae_hmd", "loss=agrol"), "position"),
    ],
)
def test_a_key_is_of_the_loss_that_other_overrides_choose(chosen: tuple[str, ...], now: str):
    assert with_present_keys(["loss.position=1"], beside=chosen) == (f"loss.{now}=1",)
    assert with_present_keys([*chosen, "loss.position=1"]) == (*chosen, f"loss.{now}=1")
    assert with_former_keys([f"loss.{now}=1"], beside=chosen) == ("loss.position=1",)
    assert with_former_keys([*chosen, f"loss.{now}=1"]) == (*chosen, "loss.position=1")


def test_a_key_of_terms_that_is_named_like_a_renamed_one_of_another_loss_stays():
    assert with_former_keys(["loss=kinematic", "loss.world_position=1"])[1] == "loss.world_position=1"


@pytest.mark.parametrize("signs", ["+", "++", "~"])
def test_what_an_override_begins_with_stays(signs: str):
    assert with_present_keys([f"{signs}frame.normalize=false"]) == (f"{signs}normalizer.z_scores=false",)
    assert with_former_keys([f"{signs}normalizer.z_scores=false"]) == (f"{signs}frame.normalize=false",)
    assert with_former_keys(["~normalizer"]) == ("~frame",)


def test_overrides_have_their_former_names():
    words = [
        "model=bodiffusion",
        "model.noise_weight=0.5",
        "normalizer.z_scores=false",
        "loggers=none",
        "seed=1,2",
    ]
    former = ("model=bodiffusion", "model.noise=0.5", "frame.normalize=false", "tracking=none", "seed=1,2")
    assert with_former_keys(words) == former
    assert with_present_keys(former) == tuple(words)
    assert with_former_keys(["loss=of_network"]) == ("loss=own",)
    assert with_former_keys(["model=sage", "model.noise=1"]) == ("model=sage", "model.noise=1")


def test_a_key_that_never_was_has_no_present_name():
    assert present_key("data.sources", ["drawn_by", "root"]) is None
    assert present_key("loss.rotation", ["lr"]) is None
    assert present_key("optim", ["loss"]) is None
