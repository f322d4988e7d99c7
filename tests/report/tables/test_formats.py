"""Tables on the screen, in Markdown, LaTeX and JSON."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from fake_runs import CLIPS, fake_sweep, table_of
from fake_table import SHIPPED, cell, printed

from memmlp.report.tables.table import Table
from memmlp.report.tables.table_text import FORMATS
from memmlp.sweep.sweep_file import load_sweep


def test_only_costs_need_one_block(tmp_path: Path):
    sweep = load_sweep(SHIPPED / "table16.yaml")
    table = table_of(sweep, fake_sweep(tmp_path, sweep))
    assert len(table.modes) == 1
    assert not {"stream mode", "window mode"} & set(printed(table, 100).splitlines())
    assert table.flags == ()


def test_long_labels_fold_so_that_four_metrics_fit(tmp_path: Path):
    sweep = load_sweep(SHIPPED / "table04.yaml")
    assert printed(table_of(sweep, fake_sweep(tmp_path, sweep)), 100).count("Jitter ↓") == 2


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
        assert text.count(f"{len(sweep.seeds)}/{len(sweep.seeds)}") >= len(sweep.runnable())


def test_screen_shows_everything_of_an_variant(table: Table):
    lines = [line.split("  ") for line in printed(table, 100).splitlines()]
    words = [[word.strip() for word in line if word.strip()] for line in lines]
    start = next(i for i, line in enumerate(words) if line[:1] == ["no | memory"])
    assert words[start][1] == "3/3"
    assert re.fullmatch(r"\d\.\d\d ± \d\.\d\d", words[start][2])
    assert re.fullmatch(r"\+\d\.\d+\*", words[start + 1][1])
    assert re.fullmatch(r"\[\d\.\d+, \d\.\d+\]", words[start + 2][0])
    assert words[start + 3][:3] == ["holds", "opposite", "higher"]
    assert words[start + 4][:3] == ["paper", "2.76 (+0.19 ✓)", "3.00 (−0.08 ✗)"]  # noqa: RUF001
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
