"""Tables as text: words, the screen, Markdown, LaTeX and JSON."""

import json
import re
from pathlib import Path

import pytest
import yaml
from fake_runs import fake_sweep, table_of
from fake_table import SHIPPED, cell, printed
from markdown_it import MarkdownIt

from memmlp.report.tables.table import Cell, Effect, Table
from memmlp.report.tables.table_text import FORMATS, MINUS, explain_marks, format_effect, format_value
from memmlp.sweep.sweep_file import load_sweep


def test_costs_show_how_many_times_the_controls_they_are(tmp_path: Path):
    sweep = load_sweep(SHIPPED / "table17.yaml")
    table = table_of(sweep, fake_sweep(tmp_path, sweep))
    ms = [row.cells[table.modes[0]]["ms"].mean for row in table.rows]
    for ratio in (ms[1] / ms[0], 30.1 / 6.0):
        assert f"(x {ratio:.3g})" in printed(table, 100)


FORMATTED = [  # seeds' values, effect, metric, and their texts
    # below a tenth, of a custom metric, which may have any unit
    ({0: 0.0031, 1: 0.0035}, Effect(-0.0004, low=-0.0011, high=0.0003), "slide", "0.0033 ± 0.0003",
     (f"{MINUS}0.00040", f"[{MINUS}0.00110, 0.00030]")),
    ({0: 0.0031}, Effect(0.0004), "slide", "0.0031", ("+0.0004",)),
    ({0: 4.25, 1: 4.31}, Effect(0.123, low=0.05, high=0.196), "MPJRE", "4.28 ± 0.04",
     ("+0.123", "[0.050, 0.196]")),
    # a star has a digit beside it
    ({0: 8.0}, Effect(0.0004, low=0.0001, high=0.0007, holm=0.01), "MPJPE", "8.00",
     ("+0.0004*", "[0.0001, 0.0007]")),
    ({0: 8.0}, Effect(0.0004, low=-0.0001, high=0.0009, holm=0.3, bootstrap=0.123, groups=9), "MPJPE", "8.00",
     ("+0.000", f"[{MINUS}0.000, 0.001]", "p 0.3", "bootstrap 0.12")),
    # large costs and their differences have no exponent
    ({0: 1234.5}, Effect(0.0), "FPS", "1234", None),
    ({0: 2500.0}, Effect(1500.0), "FPS", "2500", ("+1500", "(x 2.5)")),
]  # fmt: skip


@pytest.mark.parametrize(("values", "effect", "metric", "value", "difference"), FORMATTED)
def test_digits_of_values_and_differences(values, effect: Effect, metric: str, value: str, difference):
    shown = Cell(values, effect=effect)
    assert format_value(shown, metric) == value
    assert difference is None or format_effect(shown, metric) == difference


def test_markdown_escapes(table: Table):
    text = FORMATS["md"](table)
    rows = [re.split(r"(?<!\\)\|", line) for line in text.splitlines() if line.startswith("|")]
    assert {len(row) for row in rows} == {2 + 2 + 5}
    assert r"no \| memory" in text
    for words in (r"full\_model", r"\<parts\>", "a note of the file", r"by position: as \<printed\>"):
        assert words in text


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
    assert (found["agrees"], found["paper"], content["rows"][0]["wanted"]) == (False, 3.0, [])


def test_every_format_keeps_any_label(tmp_path: Path):
    labels = ["off", "010", "[2]", "*", "-x", "a|b", "[red]:bug:", "$x$ & 5 %", "~/é😀", "a--b", "&amp;"]
    labels.append("</script>")
    path = tmp_path / "any.yaml"
    content = {"variants": {label: [] for label in labels}}
    path.write_text(yaml.safe_dump(content, allow_unicode=True, sort_keys=False))
    sweep = load_sweep(path)
    table = table_of(sweep, fake_sweep(tmp_path, sweep))
    assert [row.label for row in table.rows] == labels
    assert explain_marks(table) == ""
    tokens = MarkdownIt("commonmark").enable(["table", "strikethrough"]).parse(FORMATS["md"](table))
    shown = {"".join(child.content for child in token.children or ()) for token in tokens}
    assert {*labels} <= shown
    assert all(label.split()[0][:8] in printed(table, 200) for label in labels)
    assert not re.search(r"^[\[*(]", FORMATS["tex"](table), re.MULTILINE)
