"""What counts for a run's identity."""

from __future__ import annotations

import pytest
from begun_runs import CONFIG, identity

import memmlp.runs.recipe_versions
from memmlp.runs.identity import (
    NEUTRAL,
    Identity,
    changes_training,
    deployment_id,
    evaluation_id,
    flatten,
)


def test_identity_is_sixteen_hex_digits_that_never_change():
    assert identity() == "52c6c5239e75f155"


def test_what_changes_the_result_changes_the_identity():
    changed = {"seed": 1}, {"model": {"width": 16, "layers": [4, 2]}}, {"new": 0}, {"database": 1}
    others = [{"config": CONFIG | one} for one in changed]
    for other in (*others, {"kind": "vqvae"}, {"data": "e"}, {"upstream": None}):
        assert identity(**other) != identity(), other


def test_a_components_recipe_moves_the_runs_that_use_it_and_no_others(monkeypatch: pytest.MonkeyPatch):
    gru, lstm = ({**CONFIG, "memory": {"name": name}} for name in ("gru", "lstm"))
    before = identity(gru), identity(lstm)
    monkeypatch.setitem(memmlp.runs.recipe_versions.RECIPES, "memory.gru", 2)
    assert identity(gru) != before[0]
    assert identity(lstm) == before[1]


def test_what_a_run_is_does_not_move_with_recipes(monkeypatch: pytest.MonkeyPatch):
    config = {**CONFIG, "memory": {"name": "gru"}}
    codes = Identity("vqvae", {"vqvae": {"codebook": "ema"}}, "d")
    own = Identity("memmlp", config, "d", codes)
    what, before = own.what, own.id
    monkeypatch.setitem(memmlp.runs.recipe_versions.RECIPES, "vqvae", 2)
    assert own.id != before  # by its VQ-VAE's
    assert own.what == what
    assert Identity("memmlp", config, "e", codes).what != what


def test_stages_have_identities_of_what_changes_them_alone():
    def of(**changes: object) -> tuple[str, str, str]:
        config = {**CONFIG, "evaluation": {"ik": "off", "ik_iterations": 15, "batch": 4}, "export": {"a": 1}}
        for key, value in changes.items():
            group, name = key.split("__")
            config[group] = {**config.get(group, {}), name: value}
        return identity(config), evaluation_id(config, "stream"), deployment_id(config)

    def moved(**changes: object) -> list[bool]:
        return [a != b for a, b in zip(of(), of(**changes), strict=True)]

    assert moved(evaluation__ik="lbfgs") == [False, True, False]
    assert moved(evaluation__ik_iterations=3) == [False, False, False]  # there is no inverse kinematics
    assert moved(evaluation__batch=1) == [False, False, False]
    assert moved(export__a=2) == [False, False, True]
    assert moved(optim__lr=1) == [True, False, False]
    assert moved(memory__blend=1) == [False, True, True]
    rolled = {"rollout": {"name": "own_predictions"}, "memory": {"blend": 1}}
    assert identity(CONFIG | rolled) != identity(CONFIG | {**rolled, "memory": {"blend": 0}})


def test_what_cannot_change_the_result_does_not():
    for key in set(NEUTRAL) - {"data"}:
        top, *inner = key.split(".")
        tree: object = "anything"
        for name in reversed(inner):
            tree = {name: tree}
        merged = CONFIG | {top: {**CONFIG.get(top, {}), **tree} if isinstance(tree, dict) else tree}
        assert identity(merged) == identity(), key
    here, elsewhere = (identity(CONFIG | {"data": {"root": root}}) for root in ("here", "elsewhere"))
    assert here == elsewhere


def test_equal_numbers_and_orders_are_one_identity():
    same = {"optim": {"log_every": 5, "lr": 0.001}, "model": {"layers": (2.0, 4), "width": 16.0}, "seed": 0}
    assert identity(same) == identity()


def test_flatten_keeps_lists_and_empty_mappings():
    assert flatten({"a": {"b": 1, "c": {}}, "d": [1]}) == {"a.b": 1, "a.c": {}, "d": [1]}


def test_keys_that_older_runs_lack_count_only_where_they_change_something():
    """Fixed weights and windows without a mirror are what runs have from before there were such keys."""
    terms = {**CONFIG, "loss": {"name": "terms", "rotation": 1.0}, "data": {"drawn_by": "frames"}}

    def of(**changes: dict) -> str:
        config = {**terms, **{group: {**terms[group], **keys} for group, keys in changes.items()}}
        return Identity("memmlp", config, "d").what  # recipe versions, which move as well, do not count

    assert of(loss={"weighting": "fixed", "lr": 0.01}, data={"mirror": False}) == of()
    names = {"name": "adamw"}
    assert of(optim={**names, "warmup": 0, "ema": None}) == of()
    others = [{"warmup": 2}, {"ema": 0.9}, {**names, "name": "muon"}]
    assert len({of(), *(of(optim=other) for other in others)}) == 4
    muon, vectors = {**names, "name": "muon"}, [{"vectors": "muon"}, {"vectors": "adamw"}]
    assert [of(optim=muon | one) == of(optim=muon) for one in vectors] == [True, False]
    ours = [of(optim=muon | one, model={"name": "recurrent_poser"}) for one in ({}, *vectors)]
    assert len(set(ours)) == 1
    learned = of(loss={"weighting": "learned", "lr": 0.01})
    assert len({of(), learned, of(loss={"weighting": "learned", "lr": 0.1}), of(data={"mirror": True})}) == 4


def test_weights_of_terms_that_are_not_there_do_not_count():
    """They count as their defaults, so that runs with these keep their ids."""
    weights = {"rotation_all": 1.0, "position_branch": 0.5, "velocity_lower_body": 0.1, "hand": 0.1}

    def of(term: str, predictor: str = "two_branch", **others: float) -> str:
        loss = {"name": "manual", **weights, **others}
        slots = {"hand": {"name": term}, "predictor": {"name": predictor}, "loss": loss}
        return Identity("memmlp", {**CONFIG, **slots}, "d").what

    assert of("off", hand=9.0) == of("off") == "87063d950dc5b521"
    assert of("fk", hand=9.0) != of("fk")
    assert of("off", position_branch=9.0) != of("off")
    alone = "rotation_only"
    assert of("off", alone, position_branch=9.0, velocity_lower_body=9.0, hand=9.0) == of("off", alone)
    assert of("off", alone, rotation_all=9.0) != of("off", alone)
    config = {**CONFIG, "hand": {"name": "off"}, "loss": {"name": "manual", **weights}}
    assert [changes_training(f"loss.{name}", config) for name in ("hand", "position_branch")] == [False, True]
