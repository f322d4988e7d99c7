"""Rows, cells and effects of measured runs beside the paper's values."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fake_runs import fake_sweep, table_of
from fake_table import cell, printed

from memmlp.report.tables.table import Cell, Effect, Table
from memmlp.runs.run import Run
from memmlp.sweep.definition import Sweep
from memmlp.sweep.sweep_file import parse_sweep


def test_mean_and_sd_over_seeds(sweep: Sweep, table: Table, tmp_path: Path):
    runs = [Run(folder) for folder in (tmp_path / "runs").iterdir()]
    reports = [
        json.loads(run.evaluation("window-0").read_text())
        for run in runs
        if run.config["overrides"] == ["memory=none"]
    ]
    mine = [report["mean"]["rotation"]["MPJPE"] for report in reports]
    found = cell(table, "no | memory", "MPJPE", "window")
    assert sorted(found.values.values()) == sorted(mine)
    assert found.mean == pytest.approx(np.mean(mine))
    assert found.sd == pytest.approx(np.std(mine, ddof=1))


def test_signs_against_the_paper(table: Table):
    assert cell(table, "no | memory", "MPJRE").agrees is True  # +0.19 in the paper, worse here too
    assert cell(table, "no | memory", "MPJPE").agrees is False  # -0.08 in the paper
    assert cell(table, "no | memory", "Jitter").agrees is None  # no difference in the paper
    assert cell(table, "by position", "MPJPE").agrees is None  # not in the paper


def test_what_the_table_could_have_seen(table: Table, sweep: Sweep, tmp_path: Path):
    """A table could have seen the largest of what its variants could, and here a larger effect."""
    least = [cell(table, label, "MPJPE").effect.detectable for label in ("no | memory", "by position")]
    assert table.find_detectable("stream", "MPJPE") == max(least)
    assert f"MPJPE: a true difference of {max(least):.2g} (stream)" in printed(table, 200)
    assert cell(table, "no | memory", "MPJPE").effect.mean > least[0]


@pytest.mark.parametrize(
    ("factor", "printed_ms", "ms", "fps"),
    [
        (1.2, "6.8 (+0.8)", None, None),
        (1.3, "6.8 (+0.8 ✓)", True, True),
        (0.85, "6.8 (+0.8)", None, None),
        (0.7, "6.8 (+0.8 ✗)", False, False),
    ],
)
def test_times_agree_with_the_paper_beyond_their_noise_alone(
    factor: float, printed_ms: str, ms: bool | None, fps: bool | None, tmp_path: Path
):
    variants = {"one": {"overrides": ["a=b"], "paper": {"ms": 6.8, "FPS": 65.0}},
            "control": {"overrides": [], "paper": {"ms": 6.0, "FPS": 72.0}}}  # fmt: skip
    file = {
        "title": "Times",
        "seeds": [0],
        "control": "control",
        "metrics": ["ms", "FPS"],
        "variants": variants,
    }
    sweep = parse_sweep("times", file)
    made = table_of(sweep, fake_sweep(tmp_path, sweep, {"one": factor}))
    assert (cell(made, "one", "ms").agrees, cell(made, "one", "FPS").agrees) == (ms, fps)
    assert printed_ms in " ".join(printed(made, 200).split())


def test_a_missing_mark_of_a_time_is_explained_beside_others(tmp_path: Path):
    """Costs that are exact go by their sign, however small; the legend says what of times is noise."""
    variants = {"slow": {"overrides": ["a=b"], "paper": {"ms": 6.8}},
            "slower": {"overrides": ["a=c"], "paper": {"ms": 9.0}},
            "control": {"overrides": [], "paper": {"ms": 6.0}}}  # fmt: skip
    file = {"title": "Times", "seeds": [0], "control": "control", "metrics": ["ms"], "variants": variants}
    sweep = parse_sweep("times", file)
    find = fake_sweep(tmp_path, sweep, {"slow": 1.1, "slower": 2.0})
    assert "of a cost by its sign, of a time from x 1.25 on)" in printed(table_of(sweep, find), 200)
    assert Cell({0: 1.001}, 2.0, Effect(0.001), 1.0).agrees is True
