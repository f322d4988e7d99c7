"""The section and the figure of a sweep's effects against its scale."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from pathlib import Path

import pytest
from fake_cells import STEP, cells
from PIL import Image

from memmlp.report.kept_results import Kept, dumps, load_kept, overrides_of, save
from memmlp.report.result_pages import KeptTable, Placeholders, pages
from memmlp.report.scaling_figure import figure_is_of, scaling_figure
from memmlp.report.scaling_section import bounds_words, power, scaling_section
from memmlp.tables.build_table import make_table
from memmlp.tables.effects_along_axes import Bounds, Trends, trends
from memmlp.tables.measured_run import Measured
from memmlp.tables.table_text import MINUS

PAPER = {"profile=paper": STEP * 8000 * 30}


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Kept:
    sweep, runs = cells(tmp_path_factory.mktemp("cells"), lambda steps: 1 + 0.1 * math.log10(steps / 500))
    return Kept("cells", (), runs, overrides_of(sweep), predicted=PAPER)


@pytest.fixture(scope="module")
def found(kept: Kept, tmp_path_factory: pytest.TempPathFactory) -> Trends:
    sweep, _ = cells(tmp_path_factory.mktemp("again"), lambda steps: 1.0)
    return trends(sweep, kept.runs, kept.predicted)


def test_the_section_has_what_the_lines_say(found: Trends):
    text = scaling_section(found)
    trend = found.trends[0]
    numbers = [trend.slopes["compute"].change, trend.at(), trend.predicted.effect]
    row = next(line for line in text.splitlines() if line.startswith("| none | MPJPE"))
    assert [word.strip() for word in row.split("|")[4:9]] == [
        bounds_words(numbers[0]), "grows", bounds_words(numbers[1]), bounds_words(numbers[2]), "higher",
    ]  # fmt: skip
    assert "from 5.0 · 10¹¹ FLOP to 8.0 · 10¹² FLOP" in text
    assert "`profile=paper` is 2.4 · 10¹⁴ FLOP, 30 times the largest measured compute: 1.5 decades" in text
    assert "too far to trust a straight line" in text
    assert "the prediction for `profile=paper` has `data.split.train_fraction=1`" in text
    assert "14 of 14 cells (arm x point of the axes), 2 seeds each; their trainings took 2.3 hours" in text
    assert "- **none**: against compute grows in MPJPE" in text
    assert "![The effects of cells with their lines](cells.png)" in text


@pytest.mark.parametrize(
    ("compute", "words"),
    [
        (4e12, "within what was measured"),
        (1.5e13, "a short way, for which"),
        (4e11, "1.2 times below the smallest measured compute: 0.1 decades further"),
        (4e11, "a short way, for which"),
        (5e9, "100 times below the smallest measured compute: 2.0 decades further"),
        (5e9, "too far to trust a straight line"),
        (None, "is kept; memmlp"),
    ],
)
def test_how_far_a_prediction_may_be_trusted_follows_from_the_numbers(found: Trends, compute, words: str):
    assert words in scaling_section(replace(found, compute=compute))


@pytest.mark.parametrize("rollout", ["teacher_forcing", "own_predictions"])
def test_calls_that_compute_leaves_out_are_told_where_there_are_any(tmp_path: Path, rollout: str):
    """A rollout on own predictions makes its history by calls without gradients; the control's count."""
    sweep, runs = cells(tmp_path, lambda steps: 1.0)
    for label in runs:
        made = rollout if label.startswith("full") else "own_predictions"
        runs[label] = {seed: trained_with(run, f"rollout.{made}") for seed, run in runs[label].items()}
    text = scaling_section(trends(sweep, runs))
    told = "8.0 · 10¹²; calls without gradients, by which a rollout makes its history, are left out\n" in text
    assert told == (rollout == "own_predictions")


def trained_with(run: Measured, component: str) -> Measured:
    return replace(run, origin=replace(run.origin, recipes={**run.origin.recipes, component: 1}))


def test_without_lines_it_says_why(found: Trends):
    bare = [replace(trend, line=None, slopes={}, predicted=None, reason="why_not") for trend in found.trends]
    text = scaling_section(replace(found, trends=tuple(bare)))
    assert "- 'none': why\\_not" in text
    assert ".png" not in text


def test_a_sweep_with_a_scale_has_the_section_before_its_table(kept: Kept, found: Trends, tmp_path: Path):
    sweep, _ = cells(tmp_path, lambda steps: 1.0)
    table = make_table(sweep, kept.runs)
    text = pages({"cells": KeptTable(kept, table, (), found)}, {})["cells.md"]
    assert text.index("### Effects against compute") < text.index("### Memory with more steps")
    assert text.count("of 'none' from 'full' in the same cell") == 1
    summary = Placeholders({"cells": KeptTable(kept, table, (), found)}).summary("cells")
    assert [line[:12] for line in summary.splitlines()] == ["- `profile=p", "- the predic", "- **none**: "]


def test_what_trainings_took_is_kept(kept: Kept, tmp_path: Path):
    save(tmp_path / "kept.json", kept)
    read = load_kept(tmp_path / "kept.json")
    assert read.predicted == PAPER
    assert [run.training for run in read.every] == [run.training for run in kept.every]
    assert read.every[0].training == {
        "seconds": 300.0,
        "flops": pytest.approx(read.every[0].training["flops"]),
    }
    assert dumps(read) == dumps(kept)
    assert kept.merged(replace(kept, predicted={"a=1": 2.0})).predicted == {**PAPER, "a=1": 2.0}


def test_the_figure_is_a_picture_of_these_numbers(found: Trends, tmp_path: Path):
    path = tmp_path / "cells.png"
    assert not figure_is_of(path, found)
    path.write_bytes(scaling_figure(found))
    with Image.open(io.BytesIO(path.read_bytes())) as image:
        assert image.size[0] > image.size[1] > 200
        assert len(set(image.convert("L").tobytes())) > 50
    assert figure_is_of(path, found)
    point = found.trends[0].points[0]
    other = replace(point, effect=replace(point.effect, mean=point.effect.mean + 0.1))
    changed = replace(found.trends[0], points=(other, *found.trends[0].points[1:]))
    assert not figure_is_of(path, replace(found, trends=(changed, *found.trends[1:])))
    path.write_bytes(b"no picture")
    assert not figure_is_of(path, found)


def test_numbers_in_words():
    assert power(5.71e12) == "5.7 · 10¹²"
    assert bounds_words(Bounds(0.42, 0.1, 0.74)) == "+0.42 (0.10 to 0.74)"
    assert bounds_words(Bounds(-0.42, math.nan, math.nan)) == f"{MINUS}0.42"
    assert bounds_words(Bounds(0.0, -1.0, 1.0)) == f"0 ({MINUS}1.00 to 1.00)"
    assert bounds_words(Bounds(4e-4, 1e-4, 7e-4)) == "+0.00040 (0.00010 to 0.00070)"  # of errors in metres
