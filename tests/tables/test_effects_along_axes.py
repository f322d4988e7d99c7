"""Effects as lines through the cells of a sweep: which cells, which numbers, which verdicts."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_cells import STEP, STEPS, cells, steps_of

from memmlp.tables.build_table import make_table
from memmlp.tables.effects import paired
from memmlp.tables.effects_along_axes import Trend, TrendVerdict, trends
from memmlp.tables.statistics.effect_regression import fit
from memmlp.tables.table import Key

PAPER = {"profile=paper": STEP * 1e6}


def course(first: float, last: float):
    """Factors on the errors that go from one to another along a straight line, by the steps' logarithm."""

    def factor(steps: int) -> float:
        return first + (last - first) * math.log(steps / STEPS[0]) / math.log(STEPS[-1] / STEPS[0])

    return factor


def trend_of(folder: Path, first: float, last: float, **changes) -> Trend:
    sweep, runs = cells(folder, course(first, last), **changes)
    return next(one for one in trends(sweep, runs, PAPER).trends if one.metric == "MPJPE")


@pytest.mark.parametrize(
    ("first", "last", "verdict"),
    [
        (1.0, 1.4, TrendVerdict.GROWS),
        (0.9, 0.6, TrendVerdict.GROWS),
        (1.4, 1.0, TrendVerdict.FADES),
        (0.7, 1.4, TrendVerdict.TURNS),
        (1.2, 1.2, TrendVerdict.NONE),
    ],
)
def test_a_verdict_tells_where_the_effect_goes(
    tmp_path: Path, first: float, last: float, verdict: TrendVerdict
):
    trend = trend_of(tmp_path, first, last)
    assert trend.slopes["compute"].verdict == verdict
    assert trend.slopes["data.split.train_fraction"].verdict == TrendVerdict.NONE
    per_decade = (last - first) / math.log10(STEPS[-1] / STEPS[0])
    assert trend.slopes["compute"].change.mean == pytest.approx(6.5 * per_decade, abs=1.0)
    assert trend.at().mean == pytest.approx(6.5 * (last - 1), abs=0.7)


def test_the_line_is_that_of_the_cells_differences(tmp_path: Path):
    """Of all seeds and clips of each cell, against the logarithms of compute and data."""
    sweep, runs = cells(tmp_path, course(1.0, 1.3))
    trend = next(one for one in trends(sweep, runs).trends if one.metric == "Jitter")
    arms = [arm for arm in sweep.arms if arm.series == "none"]
    pairs = [paired(sweep, runs, ("stream",))[Key(arm.label, "stream", "Jitter")] for arm in arms]
    x = [
        [1, math.log10(STEP * steps_of(arm.cell)), math.log10(float(arm.cell[1].split("=")[1]))]
        for arm in arms
    ]
    line = fit(np.array([pair.matrix.mean(0) for pair in pairs]), np.array(x), pairs[0].groups)
    assert trend.slopes["compute"].change.mean == pytest.approx(line.slope(1).mean[0])
    assert trend.slopes["data.split.train_fraction"].change.low == pytest.approx(line.slope(2).low[0])
    assert [point.effect.mean for point in trend.points] == pytest.approx(line.effects.tolist())
    assert (trend.clips, trend.lost) == (12, 0)


def test_an_arm_with_one_head_has_its_line_as_it_has_its_row(tmp_path: Path):
    """Where a table asks for another branch, it shows the arm's rotations; so do the lines."""
    sweep, runs = cells(tmp_path, course(1.0, 1.3))
    own = [arm.label for arm in sweep.arms if arm.series == "none"]
    for run in (run for label in own for run in runs[label].values()):
        for errors, mode in itertools.product([run.means, *run.clips.values()], run.means):
            del errors[mode]["combined"]
            errors[mode]["position"]["MPJPE"] = errors[mode]["rotation"]["MPJPE"]
    sweep = sweep.with_branch("combined")
    rows = [row for row in make_table(sweep, runs).rows if row.label in own]
    for trend in trends(sweep, runs).trends:
        shown = [row.cells["stream"][trend.metric].effect.mean for row in rows]
        assert [point.effect.mean for point in trend.points] == shown


def test_a_prediction_is_wider_than_the_line(tmp_path: Path):
    sweep, runs = cells(tmp_path, course(1.0, 1.4))
    found = trends(sweep, runs, PAPER)
    trend = found.trends[0]
    line = trend.at({"compute": found.compute})
    there = trend.predicted
    assert there is not None
    assert there.effect.mean == pytest.approx(line.mean)
    assert there.effect.low < line.low < line.high < there.effect.high
    assert there.sign == 1
    assert trends(sweep, runs).trends[0].predicted is None


def test_signs_of_predictions_are_corrected_for_their_number(tmp_path: Path):
    """One of two that is significant alone is not, where it is not so at half the level."""
    sweep, runs = cells(tmp_path, course(1.0, 1.01))
    found = trends(sweep, runs, {"profile=paper": STEP * 1e5})
    there = np.array([[1, math.log10(STEP * 1e5), 0]])
    alone = [trend.line.at(there, another=True).p[0] for trend in found.trends]
    assert 0.025 < min(alone) < 0.05
    assert [trend.predicted.sign for trend in found.trends] == [0, 0]


def test_cells_of_the_same_runs_count_once(tmp_path: Path):
    """Two names for one point of a grid must not make the line surer."""
    sweep, runs = cells(tmp_path, course(1.0, 1.3))
    last, first = (next(a.label for a in sweep.arms if a.series == s) for s in ("none", "full"))
    other = [a.label for a in sweep.arms if "train_fraction=0.25" in a.label]
    runs |= {other[1]: runs[last], other[0]: runs[first]}
    assert len(trends(sweep, runs).trends[0].points) == 6


def test_a_cell_without_a_number_is_no_cell(tmp_path: Path):
    """A run that diverged is left out, and does not take the other cells' clips with it."""
    sweep, runs = cells(tmp_path, course(1.0, 1.3))
    label = sweep.arms[-1].label
    for run in runs[label].values():
        for clip in run.clips.values():
            clip["stream"]["rotation"]["MPJPE"] = math.nan
    trend = trends(sweep, runs).trends[0]
    assert (len(trend.points), trend.clips, trend.lost) == (6, 12, 0)


def test_clips_that_some_cells_lack_are_counted_and_leave_no_line(tmp_path: Path):
    sweep, runs = cells(tmp_path, course(1.0, 1.3))
    for run in runs[sweep.arms[-1].label].values():
        next(iter(run.clips.values()))["stream"]["rotation"]["MPJPE"] = math.nan
    trend = trends(sweep, runs).trends[0]
    assert (len(trend.points), trend.clips, trend.lost) == (7, 11, 1)
    cell = " ".join(sweep.arms[-1].cell)
    assert (trend.line, trend.reason) == (None, f"a network diverged on a test clip of {cell}")


def test_cells_that_share_no_clip_have_no_line(tmp_path: Path):
    sweep, runs = cells(tmp_path, course(1.0, 1.3))
    for number, arm in enumerate(sweep.arms[-2:]):
        for run in runs[arm.label].values():
            for clip in list(run.clips.values())[number::2]:
                clip["stream"]["rotation"]["MPJPE"] = math.nan
    trend = trends(sweep, runs).trends[0]
    assert (trend.line, trend.clips, trend.reason) == (None, 0, "its cells share no test clip")


@pytest.mark.parametrize(
    ("axes", "along", "reason"),
    [
        ([{"optim.steps": [500, 1000, 2000]}], ["compute"], "3 cells are too few, or too alike"),
        ([{"optim.steps": [500], "memory.width": [4, 8, 9]}], ["compute"], "all cells have the same compute"),
    ],
)
def test_too_few_cells_have_no_line(tmp_path: Path, axes: list, along: list, reason: str):
    trend = trend_of(tmp_path, 1, 1.3, axes=axes, scale={"along": along})
    assert trend.line is None
    assert trend.reason.startswith(reason)
    assert trend.slopes == {}


def test_compute_that_is_not_kept_is_named(tmp_path: Path):
    sweep, runs = cells(tmp_path, course(1.0, 1.3))
    full = sweep.arms[0].label
    runs[full] = {seed: replace(run, training={}) for seed, run in runs[full].items()}
    assert "memmlp results save counts it" in trends(sweep, runs).trends[0].reason
    assert trends(sweep, {label: {} for label in runs}).trends[0].reason == "no cell is measured"
