"""`memmlp bench train` compares two recipes, goes on where it was, and claims no more than it measured."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from conftest import Memmlp, one_line

from memmlp.cli.bench.time_to_error import conclusion, other_maker, summary

TINY = (
    "profile=tiny",
    "model.depth=2",
    "data.synth.minutes=0.1",
    "threads=1",
    "memory=none",
    "optim.steps=4",
)


def row(seed: int, today: float, recipe: float | None) -> dict:
    mark = {"steps": 1, "error": 1.0}
    reached = {**mark, "seconds": recipe} if recipe else None
    return {"seed": seed, "today": {**mark, "seconds": today}, "recipe": reached}


def test_ratio_interval_and_verdict_by_hand():
    """Logarithms of 2, 2.5 and 3.125 are equally far apart: ln(1.25). Student's t of 2 degrees is 4.303."""
    rows = [row(0, 20, 10), row(1, 25, 10), row(2, 31.25, 10)]
    found = summary(rows, 1.0)
    half = 4.3027 * math.log(1.25) / math.sqrt(3)
    assert found["ratio"] == pytest.approx(2.5)
    assert found["low"] == pytest.approx(2.5 * math.exp(-half), rel=1e-4)
    assert (found["verdict"], summary(rows, 2.0)["verdict"]) == ("holds", "open")
    assert summary(rows, 2.0)["ratio"] == pytest.approx(2.5)
    assert summary(rows, 9.0)["verdict"] == "opposite"


def test_a_seed_that_never_had_the_error_leaves_nothing_to_claim():
    found = summary([row(0, 20, 1), row(1, 20, 1.1), row(2, 20, None)], 1.0)
    assert (found["verdict"], found["ratio"], found["never"]) == ("open", None, [2])
    assert "never had the error with seed 2" in conclusion(found, 1)


def test_one_seed_has_no_interval():
    found = summary([row(0, 20, 10)], 1.0)
    assert (found["verdict"], found["low"]) == ("open", None)
    assert conclusion(found, 1).startswith(
        "2.00 times sooner in seconds of the processor (95 % interval over seeds: none"
    )


def test_seconds_of_several_threads_are_said_to_be_no_time_of_a_clock():
    said = conclusion(summary([row(0, 20, 10)], 1.0), 4)
    assert said.startswith("2.00 times sooner in seconds of the processor, of all 4 threads together (")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, ""),
        ({"threads": 4}, "threads 4 (here 1)"),
        ({"torch": "2.0", "cpu": "another"}, "torch 2.0 (here 2.1), cpu another (here one)"),
        ({"code": {"training/loop.py": "b"}}, "other code of training/loop.py"),
    ],
)
def test_rows_of_other_code_threads_torch_or_processors_are_told(change: dict, said: str):
    now = {"threads": 1, "torch": "2.1", "cpu": "one", "code": {"training/loop.py": "a"}}
    assert other_maker(now | change, now) == said
    assert other_maker({}, now) == "code that it does not name"


@pytest.mark.slow
def test_a_file_goes_on_with_the_seeds_that_it_lacks_and_refuses_another_comparison(
    memmlp: Memmlp, tmp_path: Path
):
    file = tmp_path / "found.json"
    recipe = ("--recipe", "optim=muon optim.lr=2e-3", "--every", "2", "--json", str(file))
    assert memmlp("bench", "train", *recipe, "--seeds", "1", *TINY).code == 0
    first = json.loads(file.read_text())["seeds"]
    ran = memmlp("bench", "train", *recipe, "--seeds", "2", *TINY)
    assert ran.code == 0, ran.err
    assert ran.out.startswith("s: seconds of the processor\nseed 0: ")
    content = json.loads(file.read_text())
    assert content["seeds"][:1] == first
    assert [one["seed"] for one in content["seeds"]] == [0, 1]
    assert first[0]["today"]["steps"] in (2, 4)
    assert first[0]["runs"]["today"] != first[0]["runs"]["recipe"]
    assert content["unit"] == "seconds of the processor"
    assert content["made_by"].keys() == {"threads", "torch", "cpu", "code"}
    file.write_text(json.dumps(content | {"made_by": content["made_by"] | {"torch": "1.0"}}))
    assert one_line(memmlp("bench", "train", *recipe, "--seeds", "2", *TINY), f"--json {file}", "torch 1.0 (")
    code = content["made_by"]["code"] | {"training/loop.py": "another"}
    file.write_text(json.dumps(content | {"made_by": content["made_by"] | {"code": code}}))
    again = memmlp("bench", "train", *recipe, "--seeds", "2", *TINY)
    assert one_line(again, f"--json {file}", "other code of training/loop.py")
    other = ("bench", "train", "--recipe", "optim.warmup=2", "--json", str(file), *TINY)
    assert one_line(memmlp(*other), f"--json {file}", "another comparison")
    changed = ("bench", "train", "--recipe", "data.synth.minutes=0.3", "--seeds", "1", *TINY)
    assert one_line(memmlp(*changed), "--recipe", "the data")


@pytest.mark.slow
def test_a_profile_has_every_part_of_both(memmlp: Memmlp):
    ran = memmlp("bench", "train", "--breakdown", "2", "--recipe", "optim=muon", *TINY)
    assert ran.code == 0, ran.err
    assert ran.out.count("matrix products") == 4
    assert " ms of the processor; with" in ran.out
    assert "recipe: " in ran.out


def test_threads_are_of_both_recipes(memmlp: Memmlp):
    assert one_line(memmlp("bench", "train", "--recipe", "threads=2"), "--recipe threads", "OVERRIDES")
