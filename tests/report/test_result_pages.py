"""Pages of results: tables, and templates whose numbers and verdicts come from the tables."""

import functools
import itertools
import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_runs import fake_sweep, runs_of
from report.conftest import GROUPS

from memmlp.cli.results import make_tables
from memmlp.common.errors import InputError
from memmlp.report.kept_results import KeptResults, list_overrides
from memmlp.report.result_pages import KeptTable, Placeholders, make_pages
from memmlp.report.tables.build_table import group_clips, make_table
from memmlp.report.tables.statistics import Verdict, estimate_error
from memmlp.report.tables.table_text import MINUS
from memmlp.sweep.definition import Sweep

ROOT = Path(__file__).parent.parent.parent
DOCS = ROOT / "docs" / "results"


def source(sweep: Sweep, kept: KeptResults) -> KeptTable:
    return KeptTable(kept, make_table(sweep, kept.select_runs(sweep), command=kept.command))


def fill(template: str, table: KeptTable) -> str:
    return make_pages({"t": table}, {"README.md": f"{template}\n"})["README.md"]


def test_a_template_takes_numbers_and_verdicts_from_the_table(sweep: Sweep, kept: KeptResults):
    made = source(sweep, kept)
    template = (
        'MPJPE {{ effect("t", "2", "stream", "MPJPE") }}; '
        '{{ value("t", "2", "stream", "MPJPE") }}. {{ verdict("t", "2, 4, 6", "window", "Jitter") }} '
        '{{ detectable("t", "stream", "MPJPE", "2") }} {% if has("u") %}never{% endif %}\n'
        '{{ title("t") }}\n{{ origin("t") }}\n{{ summary("t") }}'
    )
    text = fill(template, made)
    row = next(row for row in made.table.rows if row.label == "2")
    effect = row.cells["stream"]["MPJPE"].effect
    assert effect.verdict == Verdict.HOLDS
    assert f"MPJPE +{effect.mean:.2f} [{effect.low:.2f}, {effect.high:.2f}], holds" in text
    assert f"{row.cells['stream']['MPJPE'].mean:.2f} ± " in text
    assert f"{effect.detectable:.2g} cm" in text
    assert "`memmlp sweep table14 data=mocap`: 12 runs, commit 0123456, torch 2.0.0" in text
    assert len(re.findall(r"holds \(rotation [^)]+\); paper \+0.09", text)) == 1
    assert "never" not in text


def test_what_holds_of_the_paper_is_counted_and_listed(sweep: Sweep, kept: KeptResults):
    """Counted again from the cells; an effect without a sign in the paper is not."""
    made = source(sweep, kept)
    text = fill('{{ held(["t"]) }}', made)
    cells = [row.cells["stream"][metric] for row in made.table.rows for metric in made.table.measured_metrics]
    signed = [cell for cell in cells if cell.paper_effect]
    holds = sum(cell.effect.verdict == Verdict.HOLDS for cell in signed)
    assert 0 < holds < len(signed) == 12
    assert f"Of {len(signed)} effects with a sign in the paper, in stream mode: {holds} holds, " in text
    line = next(line for line in text.splitlines() if line.startswith("| [14](t.md) | 2 |"))
    row = next(row for row in made.table.rows if row.label == "2")
    words = [str(row.cells["stream"][metric].effect.verdict) for metric in made.table.measured_metrics]
    bare = re.sub(r" \(rotation [^)]+\)", "", line)  # without the other branches
    assert bare == f"| [14](t.md) | 2 | 2, 4, 6, 8 | {' | '.join(words)} |" != line


def test_significant_differences_are_counted_with_coarser_groups_too(sweep: Sweep, kept: KeptResults):
    """Counted again from Holm's p-values; the coarser table is the one that the source makes."""
    made = source(sweep, kept)

    def coarser(patterns: Sequence[str]):
        assert patterns == ("a", "b")
        return make_table(sweep, group_clips(kept.select_runs(sweep), ["."])[0])

    made = made._replace(regroup=coarser)
    text = fill('{{ decided("t") }}, {{ decided("t", "a", "b") }}', made).splitlines()[-1]
    cells = [cell for row in made.table.rows for own in row.cells.values() for cell in own.values()]
    effects = [cell.effect for cell in cells if cell.effect and cell.effect.verdict]
    significant = sum(effect.holm < 0.05 for effect in effects)
    assert 0 < significant < len(effects)
    assert text == f"{significant} of {len(effects)}, 0 of {len(effects)}"


@pytest.mark.parametrize(("template", "words"), [
    ('{{ effect("u", "2", "stream", "MPJPE") }}', "'u'"),
    ('{{ effect("t", "3", "stream", "MPJPE") }}', "'3'"),
    ('{{ effect("t", "2", "live", "MPJPE") }}', "'live'"),
    ('{{ effect("t", "2", "stream", "MPJ") }}', "'MPJ'"), ('{{ decided("t", "a") }}', "t: "),
    ("{{ nothing }}", "'nothing' is undefined"), ("{{ effect(", "README.md"),
])  # fmt: skip
def test_bad_templates_are_one_line(sweep: Sweep, kept: KeptResults, template: str, words: str):
    with pytest.raises(InputError, match=re.escape(words)) as raised:
        fill(template, source(sweep, kept))
    assert str(raised.value).startswith("README.md")
    assert "\n" not in str(raised.value)


@functools.cache
def clones_tables() -> dict[str, KeptTable]:
    """The tables of the clone's kept results, computed once for the tests that read them."""
    return make_tables(DOCS)


@pytest.mark.slow
def test_pages_of_the_clone_are_made_again_byte_for_byte():
    templates = {path.name: path.read_text(encoding="utf-8") for path in (DOCS / "templates").glob("*.md")}
    made = make_pages(clones_tables(), templates)
    assert "README.md" in made
    for name, text in made.items():
        assert (DOCS / name).read_bytes() == text.encode(), name


@pytest.mark.slow
def test_every_interval_of_the_clone_follows_from_what_is_kept():
    """As many intervals as the pages print are computed here from the per-clip results, and are equal."""
    for name in ("mix", "networks", "table14"):  # the first two have several sources
        one, printed = clones_tables()[name], 0
        content = json.loads((DOCS / "data" / f"{name}.json").read_text())
        sources_of = [None, *(one.kept.sources if one.by_source else ())]
        for source_name, table in zip(sources_of, (one.table, *one.by_source), strict=True):
            for row, mode in itertools.product(table.rows, table.modes):
                for metric, cell in row.cells.get(mode, {}).items():
                    printed += cell.low is not None and table.number is None  # of the mean itself
                    if cell.effect is not None and cell.effect.low is not None:
                        interval = by_hand(content, row, table, mode, metric, source_name)
                        assert (cell.effect.low, cell.effect.high) == pytest.approx(interval)
                        printed += 1
        text = (DOCS / f"{name}.md").read_text(encoding="utf-8")
        assert len(re.findall(r"\\\[[^\]]*\d, [^\]]*\d\\\]", text)) == printed


def by_hand(content: dict, row, table, mode: str, metric: str, source: str | None) -> tuple[float, float]:
    """Compute the interval of a row's difference from its control, from a file's content alone.

    source: whose clips count; None for all.
    """
    branches = {other.label: other.branch for other in table.rows}
    cells = {label: content["cells"][label] for label in (row.label, row.against)}
    seeds = sorted(set(cells[row.label]) & set(cells[row.against]))
    every = {label: [content["runs"][by_seed[seed]] for seed in seeds] for label, by_seed in cells.items()}
    clips = [{clip: rest for clip, *rest in content["clips"][runs[0]["clips"]]} for runs in every.values()]
    groups = {
        clip: group
        for clip, (group, *rest) in clips[0].items()
        if clip in clips[1] and (source is None or rest == [source])
    }
    sides = []
    for (label, runs), names in zip(every.items(), clips, strict=True):
        places = [list(names).index(clip) for clip in groups]
        sides.append(np.array([run["errors"][mode][branches[label]][metric] for run in runs])[:, places])
    differences = (sides[0] - sides[1])[None]
    half = estimate_error(differences, np.array(list(groups.values()))).compute_half_width(0.05)[0]
    return float(differences.mean() - half), float(differences.mean() + half)


def test_the_way_from_the_first_variant_to_the_last_is_the_sum_of_its_steps(sweep: Sweep, tmp_path: Path):
    """Errors grow from arm to arm of a chain; a share is shown where the interval leaves 0 out."""
    labels = [arm.label for arm in sweep.variants]
    against = {labels[0]: labels[1], labels[1]: labels[2], labels[2]: labels[0]}  # the control, two before it
    variants = tuple(replace(variant, against=against.get(variant.label)) for variant in sweep.variants)
    chained = replace(sweep, variants=variants, control=labels[0])
    find = fake_sweep(tmp_path, chained, {labels[1]: 1.1, labels[2]: 1.3}, groups=GROUPS)

    def make_words(one: Sweep) -> Placeholders:
        kept = KeptResults("table14", (), runs_of(one, find), list_overrides(one))
        return Placeholders({"t": source(one, kept)})

    words = make_words(chained)
    rows = [line.split(" | ") for line in words.steps("t").splitlines()[2:]]
    assert [row[0].strip("| ") for row in rows] == [labels[1], labels[0], f"total, from {labels[2]}"]
    column = 1 + chained.metrics.index("MPJPE")
    parts = [[word.replace(MINUS, "-") for word in row[column].split(", ")] for row in rows]
    assert float(parts[0][0]) + float(parts[1][0]) == pytest.approx(float(parts[2][0]), abs=0.011)
    assert [part[1] for part in parts[:2]] == ["67 %", "33 %"]  # 1.3 to 1.1 to 1
    assert parts[2][1].split("; paper ")[0] == str(words.verdict("t", labels[2], "stream", "MPJPE"))
    assert make_words(sweep).steps("t") == ""
