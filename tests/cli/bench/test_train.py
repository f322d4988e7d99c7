"""`memmlp bench train` compares two recipes, resumes, and claims no more than it measured."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from conftest import Memmlp, one_line

from memmlp.cli.bench.train import conclude, summarize

TINY = (
    "profile=tiny",
    "model.depth=2",
    "data.synth.minutes=0.1",
    "threads=1",
    "memory=none",
    "optim.steps=4",
)


def row(seed: int, current: float, recipe: float | None) -> dict:
    mark = {"steps": 1, "error": 1.0}
    reached = {**mark, "seconds": recipe} if recipe else None
    return {"seed": seed, "current": {**mark, "seconds": current}, "recipe": reached}


def test_ratio_interval_and_verdict_by_hand():
    """Logarithms of 2, 2.5 and 3.125 are equally far apart: ln(1.25). Student's t of 2 degrees is 4.303."""
    rows = [row(0, 20, 10), row(1, 25, 10), row(2, 31.25, 10)]
    found = summarize(rows, 1.0)
    half = 4.3027 * math.log(1.25) / math.sqrt(3)
    assert found["ratio"] == pytest.approx(2.5)
    assert found["low"] == pytest.approx(2.5 * math.exp(-half), rel=1e-4)
    assert found["verdict"] == "holds"
    assert summarize(rows, 2.0)["ratio"] == pytest.approx(2.5)
    assert summarize(rows, 2.0)["verdict"] not in ("holds", "opposite")
    assert summarize(rows, 9.0)["verdict"] == "opposite"


def test_a_seed_that_never_reached_the_error_leaves_nothing_to_claim():
    found = summarize([row(0, 20, 1), row(1, 20, 1.1), row(2, 20, None)], 1.0)
    assert (found["ratio"], found["never"]) == (None, [2])
    assert found["verdict"] not in ("holds", "opposite")
    assert "seed 2" in conclude(found)


def test_one_seed_has_no_interval():
    found = summarize([row(0, 20, 10)], 1.0)
    assert found["low"] is None
    assert conclude(found).startswith("2.00 times sooner in processor seconds (95 % interval: none")


@pytest.mark.slow
def test_a_file_resumes_with_missing_seeds_and_rejects_another_comparison(memmlp: Memmlp, tmp_path: Path):
    file = tmp_path / "found.json"
    recipe = ("--recipe", "optim=muon optim.lr=2e-3", "--every", "2", "--json", str(file))
    assert memmlp("bench", "train", *recipe, "--seeds", "1", *TINY).code == 0
    first = json.loads(file.read_text())["seeds"]
    ran = memmlp("bench", "train", *recipe, "--seeds", "2", *TINY)
    assert ran.code == 0, ran.err
    content = json.loads(file.read_text())
    assert content["seeds"][:1] == first
    assert [one["seed"] for one in content["seeds"]] == [0, 1]
    assert first[0]["current"]["steps"] in (2, 4)
    assert first[0]["runs"]["current"] != first[0]["runs"]["recipe"]
    other = ("bench", "train", "--recipe", "optim.warmup=2", "--json", str(file), *TINY)
    assert one_line(memmlp(*other), f"--json {file}")
    changed = ("bench", "train", "--recipe", "data.synth.minutes=0.3", "--seeds", "1", *TINY)
    assert one_line(memmlp(*changed), "--recipe", "the data")


def test_both_recipes_have_the_same_threads(memmlp: Memmlp):
    assert one_line(memmlp("bench", "train", "--recipe", "threads=2"), "--recipe threads", "OVERRIDES")
