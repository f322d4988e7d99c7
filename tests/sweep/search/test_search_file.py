"""Searches from configs: what is refused, and what objectives and ranges mean."""

from __future__ import annotations

from typing import Any

import pytest

from memmlp.common.errors import InputError
from memmlp.sweep.search.search_file import Range, parse_search

GOOD: dict[str, Any] = {
    "name": "mine",
    "base": ["loss=manual"],
    "space": {"loss": {"rotation_all": {"low": 0.1, "high": 10.0, "log": True, "first": 1.0}}},
    "objectives": ["MPJPE"],
    "n_trials": 3,
    "seeds": 1,
    "sampler": "tpe",
    "startup": 2,
    "seed": 0,
    "pruner": "median",
    "prune_after": 2,
    "storage": None,
}


def made(**changes: Any):
    return parse_search({**GOOD, **changes})


def space(**leaf: Any) -> dict[str, Any]:
    return {"optim": {"lr": leaf}}


def test_a_tree_of_keys_becomes_ranges():
    found = made(
        space={"loss": {"hand": {"low": 0.1, "high": 1.0}}, "hand": {"choices": ["off", "fk"], "first": "fk"}}
    )
    assert found.space == (
        Range("loss.hand", 0.1, 1.0),
        Range("hand", choices=("off", "fk"), first="fk"),
    )
    assert found.first_trials() == [{"hand": "fk"}]
    assert found.space[1].corners() == ("off", "fk")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("MPJPE", 6.0),
        ("rotation MPJPE", 6.0),
        ("position MPJPE", 5.0),
        ("MPJPE + 0.1*Jitter", 7.0),
        ("0.5 * MPJPE + 2*position Hand PE", 5.0),
        ("1e-1*Hand PE", 0.2),
    ],
)
def test_an_objective_is_a_weighted_sum(text: str, value: float):
    metrics = {
        "rotation MPJPE": 6.0, "rotation Jitter": 10.0, "rotation Hand PE": 2.0,
        "position MPJPE": 5.0, "position Hand PE": 1.0,
    }  # fmt: skip
    assert made(objectives=[text]).objectives[0].value(metrics) == pytest.approx(value)


def test_an_objective_that_is_not_validated_is_named():
    with pytest.raises(InputError, match="'position MPJRE' is not validated; allowed are rotation MPJPE"):
        made(objectives=["position MPJRE"]).objectives[0].value({"rotation MPJPE": 1.0})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"space": {}}, "search.space: empty"),
        ({"space": {"loss": 3}}, "search.space.loss: 3; allowed is a mapping"),
        ({"space": space(low=1.0)}, "search.space.optim.lr.high: nothing; allowed is a number"),
        ({"space": space(low=2.0, high=1.0)}, "optim.lr.high=1.0: allowed is more than low=2.0"),
        ({"space": space(low=0.0, high=1.0, log=True)}, "optim.lr.low=0.0: allowed with log is above 0"),
        ({"space": space(low=1.0, high=2.0, log=True, step=0.1)}, "optim.lr.step=0.1: allowed"),
        ({"space": space(low=1.0, high=2.0, step=0)}, "optim.lr.step=0: allowed is a number above 0"),
        ({"space": space(low=True, high=2.0)}, "optim.lr.low: True; allowed is a number"),
        (
            {"space": space(low=1.0, high=2.0, first=3.0)},
            "optim.lr.first=3.0: allowed is a value of the range",
        ),
        ({"space": space(low=1.0, high=2.0, hihg=3.0)}, "optim.lr.hihg: no such key; allowed are low"),
        ({"space": space(choices="ab")}, "optim.lr.choices: allowed is a list of at least two"),
        ({"space": space(choices=[1])}, "optim.lr.choices: allowed is a list of at least two"),
        ({"space": space(choices=[1, 2], low=1)}, "optim.lr.low: does not go with choices"),
        ({"objectives": []}, "search.objectives: 0 of them"),
        ({"objectives": ["MPJPE"] * 3}, "search.objectives: 3 of them"),
        ({"objectives": ["MPJPE", "Jitter"]}, "search.pruner=median: allowed with two objectives is none"),
        ({"objectives": ["Jitters"]}, "'Jitters'; allowed is a sum of"),
        ({"objectives": ["MPJPE - Jitter"]}, "'MPJPE - Jitter'; allowed is a sum of"),
        ({"objectives": ["head MPJPE"]}, "'head MPJPE'; allowed is a sum of"),
        ({"objectives": "MPJPE"}, "search.objectives=MPJPE: allowed is a list"),
        ({"base": [1]}, "search.base="),
        ({"n_trials": 0}, "search.n_trials=0: allowed is a whole number of at least 1"),
        ({"n_trials": True}, "search.n_trials=True"),
        ({"seeds": 0}, "search.seeds=0: allowed is a whole number of at least 1"),
        (
            {"seeds": 3, "space": {"seed": {"low": 0, "high": 9}}},
            "search.seeds=3: allowed is 1 where the space has the seed",
        ),
        ({"startup": 1.5}, "search.startup=1.5"),
        ({"startup": None}, "search.startup=None: allowed is a whole number of at least 1"),
        ({"prune_after": None}, "search.prune_after=None: allowed is a whole number of at least 1"),
        ({"seed": -1}, "search.seed=-1"),
        ({"sampler": "gp"}, "search.sampler=gp: allowed is tpe or random or grid"),
        (
            {"sampler": "grid"},
            "search.space.loss.rotation_all: with search.sampler=grid allowed are choices alone",
        ),
        (
            {"sampler": "grid", "space": space(choices=[1, 2], first=1)},
            "optim.lr: with search.sampler=grid allowed are choices alone",
        ),
        (
            {"sampler": "grid", "space": space(choices=[1, 2, 3]), "n_trials": 2},
            "search.n_trials=2: allowed with search.sampler=grid is 3, all",
        ),
        ({"pruner": "hyperband"}, "search.pruner=hyperband: allowed is median or none"),
        ({"prune_after": 0}, "search.prune_after=0"),
        ({"name": "a/b"}, "search.name=a/b"),
        ({"name": "a" * 65}, "allowed are up to 64 letters"),
        ({"storage": 5}, "search.storage=5: allowed is a URL"),
        ({"nonsense": 3}, "search.nonsense: no such key; allowed are name, base"),
        ({"objectives": ["1e*MPJPE"]}, "'1e*MPJPE'; allowed is a sum of"),
        ({"objectives": ["0*MPJPE"]}, "allowed are weights above 0"),
        ({"objectives": ["1e999*MPJPE"]}, "allowed are weights above 0"),
        ({"objectives": ["MPJPE", "MPJPE"], "pruner": "none"}, "twice the same"),
        ({"space": space(low=1.0, high=2.0, log="maybe")}, "optim.lr.log=maybe: allowed is true or false"),
        ({"space": space(low=4, high=8, step=1.5)}, "optim.lr.step=1.5: allowed is a whole number"),
        ({"space": space(low=4, high=8, step=100)}, "optim.lr.step=100: allowed is at most high - low"),
        ({"space": space(low=1, high=10, first=1.5)}, "optim.lr.first=1.5: allowed is a whole number"),
        ({"space": space(low=4, high=8, step=2, first=5)}, "optim.lr.first=5: allowed is low or some steps"),
        (
            {"space": space(choices=[1, 1])},
            "optim.lr.choices: allowed is a list of at least two values, each once",
        ),
    ],
)
def test_what_is_wrong_is_named(changes: dict[str, Any], message: str):
    with pytest.raises(InputError) as caught:
        made(**changes)
    assert message in str(caught.value)


def test_a_key_that_was_taken_away_is_named():
    with pytest.raises(InputError, match=r"search\.n_trials: has no value"):
        parse_search({key: value for key, value in GOOD.items() if key != "n_trials"})
