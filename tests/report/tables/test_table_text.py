"""Tables as text: words, the screen, Markdown, LaTeX and JSON."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
from fake_runs import CLIPS, fake_sweep, table_of
from fake_table import SHIPPED, cell, printed

from memmlp.report.tables.table import Cell, Effect, Table
from memmlp.report.tables.table_text import (
    FORMATS,
    MINUS,
    format_effect,
    format_value,
    make_legend,
)
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


def test_an_error_below_a_tenth_has_two_digits_as_its_difference_has():
    """A metric of one's own may have any unit."""
    effect = Effect(-0.0004, low=-0.0011, high=0.0003)
    small = Cell({0: 0.0031, 1: 0.0035}, effect=effect)
    assert format_value(small, "slide") == "0.0033 ± 0.0003"
    assert format_effect(small, "slide") == ("\N{MINUS SIGN}0.00040", "[\N{MINUS SIGN}0.00110, 0.00030]")
    assert format_effect(Cell({0: 0.0031}, effect=Effect(0.0004)), "slide") == ("+0.0004",)
    usual = Cell({0: 4.25, 1: 4.31}, effect=Effect(0.123, low=0.05, high=0.196))
    assert format_value(usual, "MPJRE") == "4.28 ± 0.04"
    assert format_effect(usual, "MPJRE") == ("+0.123", "[0.050, 0.196]")
    assert format_value(Cell({0: 0.0, 1: 0.0}), "slide") == "0.00 ± 0.00"


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
    monkeypatch.setattr(Table, "find_detectable", lambda *_: 901.0)
    said = " ".join(printed(table, 100).split())
    assert "901" not in said
    assert "MPJRE: too few seeds" in said


def test_power_is_that_of_the_table_where_a_run_diverged(table: Table):
    """A mean that is no number is no size that a difference could be compared with."""
    before = [line for line in make_legend(table) if "power" in line]
    bad = replace(cell(table, "no | memory", "MPJPE"), values={0: math.nan, 1: 8.0})
    rows = [
        replace(row, cells={**row.cells, "stream": {**row.cells["stream"], "MPJPE": bad}})
        if row.label == "no | memory"
        else row
        for row in table.rows
    ]
    assert [line for line in make_legend(replace(table, rows=tuple(rows))) if "power" in line] == before


def test_a_star_has_a_digit_beside_it():
    small = Effect(0.0004, low=0.0001, high=0.0007, holm=0.01)
    assert format_effect(Cell({0: 8.0}, effect=small), "MPJPE") == ("+0.0004*", "[0.0001, 0.0007]")
    open_one = Effect(0.0004, low=-0.0001, high=0.0009, holm=0.3)
    assert format_effect(Cell({0: 8.0}, effect=open_one), "MPJPE") == ("+0.000", f"[{MINUS}0.000, 0.001]")


def test_large_costs_and_their_differences_have_no_exponent():
    assert format_value(Cell({0: 999.7}), "FPS") == "1000"
    assert format_value(Cell({0: 1234.5}), "FPS") == "1234"
    assert format_value(Cell({0: 41.24}), "FPS") == "41.2"
    assert format_effect(Cell({0: 2500.0}, effect=Effect(1500.0)), "FPS") == ("+1500", "(x 2.5)")
    assert format_effect(Cell({0: 2500.0}, effect=Effect(-1500.0)), "FPS") == (f"{MINUS}1500", "(x 0.625)")
    assert format_effect(Cell({0: 2.0}, effect=Effect(0.0)), "FPS")[0] == "0"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["table04", "table17", "recurrent_poser", "scaling"])
def test_shipped_tables_fit_the_screen(tmp_path: Path, name: str):
    sweep = load_sweep(SHIPPED / f"{name}.yaml")
    table = table_of(sweep, fake_sweep(tmp_path, sweep, clips=CLIPS[:2]))
    for width in (80, 100):
        text = printed(table, width)
        assert max(map(len, text.splitlines())) <= width
        for variant in sweep.variants:
            assert variant.label.split()[0] in text
            for value in (variant.paper or {}).values():
                assert f"{value:.1f}" in text or f"{value:.2f}" in text
        assert text.count(f"{len(sweep.seeds)}/{len(sweep.seeds)}") >= len(sweep.list_runnable())


def test_screen_shows_everything_of_an_variant(table: Table):
    lines = [line.split("  ") for line in printed(table, 100).splitlines()]
    words = [[word.strip() for word in line if word.strip()] for line in lines]
    start = next(i for i, line in enumerate(words) if line[:1] == ["no | memory"])
    assert words[start][1] == "3/3"
    assert re.fullmatch(r"\d\.\d\d ± \d\.\d\d", words[start][2])
    assert re.fullmatch(r"\+\d\.\d+\*", words[start + 1][1])
    assert re.fullmatch(r"\[\d\.\d+, \d\.\d+\]", words[start + 2][0])
    assert words[start + 3][:3] == ["holds", "opposite", "higher"]
    assert all(re.fullmatch(r"p 0\.\d+", word) for word in words[start + 4])
    assert all(re.fullmatch(r"flips 0\.\d+", word) for word in words[start + 5])
    assert words[start + 6][:2] == ["position", "-"]  # positions have no MPJRE
    assert words[start + 7][:2] == ["opposite", "higher"]
    after = words[start + 8 :]
    assert after[0][0] == "combined"
    assert after[2][:3] == ["paper", "2.76 (+0.19 ✓)", "3.00 (−0.08 ✗)"]  # noqa: RUF001
    assert ["a system", "paper", "-", "4.00", "-", "-", "-"] in words


def test_markdown_escapes(table: Table):
    text = FORMATS["md"](table)
    rows = [re.split(r"(?<!\\)\|", line) for line in text.splitlines() if line.startswith("|")]
    assert {len(row) for row in rows} == {2 + 2 + 5}
    assert r"no \| memory" in text
    assert r"full\_model" in text
    assert r"\<parts\>" in text
    assert "a note of the file" in text
    assert r"by position: as \<printed\>" in text


def test_latex_escapes(table: Table):
    text = FORMATS["tex"](table)
    assert r"Memory \& its $<$parts$>$" in text
    assert r"full\_model" in text
    assert text.count(r"\toprule") == text.count(r"\bottomrule") == 1
    assert not re.search(r"[±−↓↑✓✗²³]", text)  # noqa: RUF001
    rows = [line for line in text.splitlines() if line.endswith(r"\\") and "multicolumn" not in line]
    assert {len(re.split(r"(?<!\\)&", row)) for row in rows} == {7}


def test_json_has_the_values_of_each_seed(table: Table):
    content = json.loads(FORMATS["json"](table))
    found = content["rows"][1]["cells"]["stream"]["MPJPE"]
    expected = cell(table, "no | memory", "MPJPE")
    assert found["values"] == {str(seed): value for seed, value in expected.values.items()}
    assert found["effect"]["holm"] == expected.effect.holm
    assert (found["agrees"], found["paper"]) == (False, 3.0)
    assert content["rows"][0]["wanted"] == []
