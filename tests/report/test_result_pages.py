"""Pages of results: tables, and templates whose numbers and verdicts come from the tables."""

import itertools
import json
import re
from collections.abc import Sequence
from dataclasses import replace

import pytest

from docs.results.make_pages import make_pages
from docs.results.placeholders import SEARCHED
from docs.results.table_page import KeptTable
from memmlp.common.errors import InputError
from memmlp.common.text_formats import parse_csv
from memmlp.report.kept_results import KeptResults
from memmlp.report.tables.build_table import group_clips, make_table
from memmlp.report.tables.statistics import Verdict
from memmlp.report.tables.table_text import format_counts
from memmlp.sweep.definition import Sweep


def source(sweep: Sweep, kept: KeptResults) -> KeptTable:
    table = make_table(sweep, kept.select_runs(sweep), command=kept.command)
    return KeptTable(kept, table, lambda patterns, weigh: table)


def fill(template: str, table: KeptTable) -> str:
    return make_pages({"t": table}, {"README.md": f"{template}\n"})["README.md"]


def test_a_template_names_what_holds(sweep: Sweep, kept: KeptResults):
    made = source(sweep, kept)
    text = fill('{{ decisions(["t"], "holds") }} {% if "u" in names %}never{% endif %}', made)
    row = next(row for row in made.table.rows if row.label == "2")
    holds = [m for m, cell in row.cells["stream"].items() if cell.effect.verdict == Verdict.HOLDS]
    assert "MPJPE" in holds
    assert f"Table 14 '2': {', '.join(holds)}" in text
    assert "never" not in text


def test_a_page_has_each_mean_and_its_file_every_number(sweep: Sweep, kept: KeptResults):
    made = source(sweep, kept)
    files = make_pages({"t": made}, {})
    every = [line for line in parse_csv(files["tables/t.csv"]) if line["test clips"] == "all"]
    lines = {(line["variant"], line["mode"], line["branch"], line["metric"]): line for line in every}
    assert len(lines) == len(every)
    for row, mode in itertools.product(made.table.rows, made.table.modes):
        for metric, cell in row.cells[mode].items():
            line = lines[row.label, mode, row.branch, metric]
            assert float(line["mean"]) == pytest.approx(cell.mean, rel=1e-4)
            assert line["verdict"] == ("" if cell.effect is None else cell.effect.verdict)
            assert f" {cell.mean:.2f} " in files["t.md"] or mode != made.table.modes[0]
        for branch, by_mode in row.branches.items():
            for metric, effect in by_mode[mode].items():
                line = lines[row.label, mode, branch, metric]
                numbers = [float(line[f"difference{end}"]) for end in ("", " low", " high")]
                assert numbers == pytest.approx([effect.mean, effect.low, effect.high], rel=1e-4)
    assert {branch for *_, branch, _ in lines} > {"rotation", "position"}
    remarks = json.loads(files["tables/remarks.json"])["t"]
    assert "commit 0123456" in remarks["origin"]
    assert remarks["command"] == "memmlp sweep table14 data=mocap seed=0,1,2"


def test_what_holds_of_the_paper_is_counted(sweep: Sweep, kept: KeptResults):
    """Counted again from the cells, by branch; an effect without a sign in the paper does not count."""
    made = source(sweep, kept)
    line = fill('{{ claims(["t"]) }}', made).splitlines()[-2]
    cells = [cell for row in made.table.rows for cell in row.cells["stream"].values() if cell.paper_effect]
    holds = sum(cell.effect.verdict == Verdict.HOLDS for cell in cells)
    assert 0 < holds < len(cells) == 12
    link, printed, rotation, _ = line.strip("| ").split(" | ")
    assert link.endswith("(t.md)")
    counts = [{word: int(n) for n, word in re.findall(r"(\d+) (\w+)", one)} for one in (printed, rotation)]
    assert counts[0]["holds"] == holds
    assert sum(counts[0].values()) == sum(counts[1].values()) == 12
    effects = [
        row.branches["rotation"]["stream"][m]
        for row in made.table.rows
        if row.against
        for m in row.cells["stream"]
    ]
    assert counts[1].get("holds", 0) == sum(effect.verdict == Verdict.HOLDS for effect in effects)


def test_effects_are_listed_and_counted_with_joined_clips_too(sweep: Sweep, kept: KeptResults):
    """The coarser table has other verdicts; `above_margin` leaves out the paper's small effects."""
    made = source(sweep, kept)
    coarser = make_table(sweep, group_clips(kept.select_runs(sweep), ["(.)"])[0])
    made = made._replace(regroup=lambda patterns, weigh: coarser if patterns == ("(.)",) else made.table)
    text = fill('{{ claims(["t"], "(.)") }}\n\n{{ decisions(["t"], "holds", joined="(.)") }}|', made)
    counts = format_counts(coarser.count_verdicts("stream"))
    assert f"| all, contents joined | {counts} |" in text
    assert format_counts(made.table.count_verdicts("stream")) != counts
    assert text.splitlines()[-1] == "|"  # one group decides nothing
    small = {metric: 1e9 for metric in made.table.metrics}
    wide = made._replace(table=replace(made.table, smallest=small))
    assert fill('{{ decisions(["t"], "holds", above_margin=true) }}|', wide).splitlines()[-1] == "|"
    assert "Table 14 '2'" in fill('{{ decisions(["t"], "holds", above_margin=true) }}', made)


def test_significant_effects_without_a_sign_in_the_paper_are_listed(sweep: Sweep, kept: KeptResults):
    bare = replace(sweep, table=None, variants=tuple(replace(one, paper=None) for one in sweep.variants))
    made = source(bare, kept)
    effects = [(row.label, metric, e.verdict) for row, metric, _, e in made.table.list_effects("stream")]
    verdicts = [Verdict.HIGHER, Verdict.LOWER]
    found = [fill(f'{{{{ decisions(["t"], "{verdict}") }}}}', made).splitlines()[-1] for verdict in verdicts]
    assert any(verdict in verdicts for *_, verdict in effects)
    for verdict, text in zip(verdicts, found, strict=True):
        metrics = [metric for _, metric, one in effects if one == verdict]
        assert sum(text.count(metric) for metric in set(metrics)) == len(metrics)


def test_the_lowest_error_is_of_a_variant_with_several_seeds(sweep: Sweep, kept: KeptResults):
    made = source(sweep, kept)
    rows = sorted(made.table.rows, key=lambda row: row.cells["stream"]["MPJPE"].mean)
    assert f"('{rows[0].label}')" in fill('{{ lowest("t", "MPJPE") }}', made)
    once = (replace(rows[0], found=rows[0].found[:1]), *rows[1:])
    made = made._replace(table=replace(made.table, rows=once))
    assert f"('{rows[1].label}')" in fill('{{ lowest("t", "MPJPE") }}', made)


def test_a_mean_over_more_clips_than_the_controls_has_the_shared_clips_beside_it(sweep, kept):
    made = source(sweep, kept)
    row = next(row for row in made.table.rows if row.label == "2")
    control = next(one for one in made.table.rows if one.label == row.against).cells["stream"]["MPJPE"]
    cell = row.cells["stream"]["MPJPE"]
    assert "shared clips" not in make_pages({"t": made}, {})["t.md"]
    row.cells["stream"]["MPJPE"] = replace(cell, clips=cell.clips + 5, counted=cell.counted + 5)
    shared = f"; shared clips: {control.mean + cell.effect.mean:.2f} ("
    assert make_pages({"t": made}, {})["t.md"].count(shared) == 1


def test_significant_differences_are_counted_with_coarser_groups_too(sweep: Sweep, kept: KeptResults):
    """Counted again from Holm's p-values; the coarser table is the one that the source makes."""
    made = source(sweep, kept)

    def coarser(patterns: Sequence[str], weigh_groups: bool):
        assert (patterns, weigh_groups) == (("a", "b"), False)
        return make_table(sweep, group_clips(kept.select_runs(sweep), ["(.)"])[0])

    made = made._replace(regroup=coarser)
    line = fill('{{ overview("a", "b") }}', made).splitlines()[-1]
    cells = [cell for row in made.table.rows for cell in row.cells[made.table.modes[0]].values()]
    effects = [cell.effect for cell in cells if cell.effect and cell.effect.verdict]
    significant = sum(effect.holm < 0.05 for effect in effects)
    assert 0 < significant < len(effects)
    assert line.endswith(f"| 12 | 3 | {significant} of {len(effects)} | 0 of {len(effects)} |")


@pytest.mark.parametrize(("template", "words"), [
    ('{{ claims(["u"]) }}', "'u'"), ("{{ nothing }}", "'nothing' is undefined"), ("{{ claims(", "README.md"),
])  # fmt: skip
def test_bad_templates_are_one_line(sweep: Sweep, kept: KeptResults, template: str, words: str):
    with pytest.raises(InputError, match=re.escape(words)) as raised:
        fill(template, source(sweep, kept))
    assert str(raised.value).startswith("README.md")
    assert "\n" not in str(raised.value)


def test_a_search_has_networks_with_all_trials_and_their_compute():
    template = {"t.md": "{{ searches(1, 5) }}"}
    row = dict.fromkeys(SEARCHED, "x") | {"network": "a", "trial": "0", "MPJPE": "7", "tflop": "5"}
    own = row | {"trial": "recipe", "MPJPE": "6"}
    page = make_pages({}, template, [row, own, row | {"network": "late"}])["t.md"]
    assert ("| a | 6.00 | 6.50 | recipe | x" in page, "late" in page) == (True, False)
    diverged = row | {"MPJPE": "inf", "tflop": ""}
    page = make_pages({}, {"t.md": "{{ searches(1, 5) }} {{ counted_compute() }}"}, [diverged, own])["t.md"]
    assert ("| a | 6.00 | inf | recipe | x" in page, page.split()[-4:]) == (True, ["5", "to", "5", "TFLOP"])
    with pytest.raises(InputError, match="a 0: must have 5 TFLOP"):
        make_pages({}, template, [row | {"tflop": "4"}])
