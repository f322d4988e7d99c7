"""The words of a table."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from fake_runs import fake_sweep, table_of
from fake_table import SHIPPED, cell, printed

from memmlp.report.tables.table import Cell, Effect, Table
from memmlp.report.tables.table_text import MINUS, effect_words, heading, legend, number_words, value_words
from memmlp.sweep.definition import Sweep
from memmlp.sweep.sweep_file import load_sweep


def test_costs_show_how_many_times_the_controls_they_are(tmp_path: Path):
    """The fake variants take 0.8, 0.88 and 0.96 ms, the paper's 6.0 and 30.1 ms."""
    sweep = load_sweep(SHIPPED / "table17.yaml")
    text = printed(table_of(sweep, fake_sweep(tmp_path, sweep)), 100)
    table = table_of(sweep, fake_sweep(tmp_path, sweep))
    ms = [row.cells[table.modes[0]]["ms"].mean for row in table.rows]
    assert f"(x {ms[1] / ms[0]:.3g})" in text
    assert f"(x {30.1 / 6.0:.3g})" in text


def test_heads_tell_unit_and_direction():
    assert [heading(name) for name in ("Jitter", "ms", "FPS")] == ["Jitter [10² m/s³] ↓", "ms ↓", "FPS ↑"]


def test_an_error_below_a_tenth_has_two_digits_as_its_difference_has():
    """A metric of one's own may have any unit."""
    effect = Effect(-0.0004, low=-0.0011, high=0.0003)
    small = Cell({0: 0.0031, 1: 0.0035}, effect=effect)
    assert value_words(small, "slide") == "0.0033 ± 0.0003"
    assert effect_words(small, "slide") == ("\N{MINUS SIGN}0.00040", "[\N{MINUS SIGN}0.00110, 0.00030]")
    assert effect_words(Cell({0: 0.0031}, effect=Effect(0.0004)), "slide") == ("+0.0004",)
    usual = Cell({0: 4.25, 1: 4.31}, effect=Effect(0.123, low=0.05, high=0.196))
    assert value_words(usual, "MPJRE") == "4.28 ± 0.04"
    assert effect_words(usual, "MPJRE") == ("+0.123", "[0.050, 0.196]")
    assert value_words(Cell({0: 0.0, 1: 0.0}), "slide") == "0.00 ± 0.00"


def test_an_variant_in_which_nothing_would_have_been_found_is_named(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep)
    one_seed = sweep.variants[1].label
    table = table_of(
        sweep, lambda variant, seed: find(variant, seed) if variant.label != one_seed or seed == 0 else None
    )
    said = " ".join(printed(table, 100).split())
    assert f"found in every variant but '{one_seed}' with 80 % power, a smaller one perhaps not" in said
    assert "in every variant but" not in " ".join(printed(table_of(sweep, find), 100).split())


def test_a_power_beyond_the_values_themselves_is_no_number(table: Table, monkeypatch: pytest.MonkeyPatch):
    """With two seeds that differ, MPJREs of 901 degrees would have been found."""
    assert "too few seeds" not in printed(table, 100)
    monkeypatch.setattr(Table, "detectable", lambda *_: 901.0)
    said = " ".join(printed(table, 100).split())
    assert "901" not in said
    assert "MPJRE: too few seeds" in said


def test_power_is_that_of_the_table_where_a_run_diverged(table: Table):
    """A mean that is no number is no size that a difference could be compared with."""
    before = [line for line in legend(table) if "power" in line]
    bad = replace(cell(table, "no | memory", "MPJPE"), values={0: math.nan, 1: 8.0})
    rows = [
        replace(row, cells={**row.cells, "stream": {**row.cells["stream"], "MPJPE": bad}})
        if row.label == "no | memory"
        else row
        for row in table.rows
    ]
    assert [line for line in legend(replace(table, rows=tuple(rows))) if "power" in line] == before


@pytest.mark.parametrize(
    ("value", "said"), [(99.6, "100"), (5.04, "5"), (0.123, "0.12"), (123.4, "123"), (2.5e6, "2500000")]
)
def test_two_digits_of_a_number_have_no_exponent(value: float, said: str):
    assert number_words(value) == said


def test_a_star_has_a_digit_beside_it():
    small = Effect(0.0004, low=0.0001, high=0.0007, holm=0.01)
    assert effect_words(Cell({0: 8.0}, effect=small), "MPJPE") == ("+0.0004*", "[0.0001, 0.0007]")
    open_one = Effect(0.0004, low=-0.0001, high=0.0009, holm=0.3)
    assert effect_words(Cell({0: 8.0}, effect=open_one), "MPJPE") == ("+0.000", f"[{MINUS}0.000, 0.001]")


def test_large_costs_and_their_differences_have_no_exponent():
    assert value_words(Cell({0: 999.7}), "FPS") == "1000"
    assert value_words(Cell({0: 1234.5}), "FPS") == "1234"
    assert value_words(Cell({0: 41.24}), "FPS") == "41.2"
    assert effect_words(Cell({0: 2500.0}, effect=Effect(1500.0)), "FPS") == ("+1500", "(x 2.5)")
    assert effect_words(Cell({0: 2500.0}, effect=Effect(-1500.0)), "FPS") == (f"{MINUS}1500", "(x 0.625)")
    assert effect_words(Cell({0: 2.0}, effect=Effect(0.0)), "FPS")[0] == "0"
