"""Results kept with the code, pages made of them, and prose that claims nothing by hand."""

from __future__ import annotations

import functools
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_runs import CLIPS, fake_run, fake_sweep, nothing, runs_of

from memmlp.cli.results import sources
from memmlp.common.errors import InputError
from memmlp.report.kept_results import Kept, dumps, load_kept, overrides_of, save, without_paths
from memmlp.report.markdown import KeptTable, Words, origin_words, pages
from memmlp.report.unbacked_claims import NEVER, WORDS, claims
from memmlp.sweep.parsing import load_sweep
from memmlp.sweep.spec import Sweep
from memmlp.tables.build_table import make_table
from memmlp.tables.statistics import Verdict, holm, paired_effects
from memmlp.tables.table_text import MINUS

ROOT = Path(__file__).parent.parent.parent
DOCS = ROOT / "docs" / "results"
GROUPS = {clip: f"take {number // 2}" for number, clip in enumerate(CLIPS)}


@pytest.fixture
def sweep() -> Sweep:
    return load_sweep(ROOT / "sweeps" / "table14.yaml")


@pytest.fixture
def kept(sweep: Sweep, tmp_path: Path) -> Kept:
    find = fake_sweep(tmp_path, sweep, {"2": 1.1, "2, 4": 1.03}, groups=GROUPS)
    return Kept("table14", ("data=mocap",), runs_of(sweep, find), overrides_of(sweep))


def source(sweep: Sweep, kept: Kept) -> KeptTable:
    return KeptTable(kept, make_table(sweep, kept.of(sweep), command=kept.command))


def test_kept_results_make_the_runs_table(sweep: Sweep, kept: Kept, tmp_path: Path):
    """The table is the same to six digits, with every origin and every group."""
    save(tmp_path / "kept.json", kept)
    read = load_kept(tmp_path / "kept.json")
    assert (read.sweep, read.overrides, read.command) == (
        "table14", ("data=mocap",), "memmlp sweep table14 data=mocap",
    )  # fmt: skip
    tables = [make_table(sweep, one.of(sweep)) for one in (kept, read)]
    assert tables[0].flags == tables[1].flags
    for before, after in zip(tables[0].rows, tables[1].rows, strict=True):
        for mode in tables[0].modes:
            for metric, cell in before.cells[mode].items():
                again = after.cells[mode][metric]
                assert again.mean == pytest.approx(cell.mean, rel=1e-5)
                if cell.effect:
                    assert again.effect.low == pytest.approx(cell.effect.low, rel=1e-4, abs=1e-4)
                    assert (again.effect.verdict, again.effect.groups) == (cell.effect.verdict, 6)
    assert [run.origin for run in read.every] == [run.origin for run in kept.every]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_run_that_diverged_stays_one(sweep: Sweep, kept: Kept, tmp_path: Path, number: float):
    """It is no run less: its arm has no mean, and no other arm's looks better for it."""
    run = kept.runs["2"][1]
    for clip in run.clips:
        run.clips[clip]["stream"]["combined"]["MPJPE"] = number
    run.means["stream"]["combined"]["MPJPE"] = number
    save(tmp_path / "kept.json", kept)
    cells = [
        next(row for row in make_table(sweep, one.of(sweep)).rows if row.label == "2").cells["stream"][
            "MPJPE"
        ]
        for one in (kept, load_kept(tmp_path / "kept.json"))
    ]
    for cell in cells:
        assert sorted(cell.values) == [0, 1, 2]
        assert not np.isfinite(cell.mean)


def test_a_run_on_a_part_of_its_list_stays_marked(kept: Kept, tmp_path: Path):
    """And files of runs on the whole of it are as they were before there were parts."""
    run = kept.runs["2"][1]
    kept.runs["2"][1] = replace(run, origin=replace(run.origin, partial="3 of 5 clips", offline=True))
    save(tmp_path / "kept.json", kept)
    assert (tmp_path / "kept.json").read_text().count('"partial"') == 1
    found = load_kept(tmp_path / "kept.json").runs["2"][1].origin
    assert (found.partial, found.offline) == ("3 of 5 clips", True)


def test_kept_results_that_were_cut_are_refused(kept: Kept, tmp_path: Path):
    """A clip's error lost by hand or in a merge would shift the others to the wrong clips."""
    content = json.loads(dumps(kept))
    del content["digest"]
    next(iter(content["runs"].values()))["errors"]["stream"]["rotation"]["MPJPE"].insert(0, 5.0)
    (tmp_path / "kept.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="has not as many errors as clips"):
        load_kept(tmp_path / "kept.json")


def test_kept_results_that_were_edited_are_refused(kept: Kept, tmp_path: Path):
    text = dumps(kept)
    number = re.search(r'"MPJPE": \[(\S+),', text)
    (tmp_path / "kept.json").write_text(text.replace(number[1], "9.99", 1))
    with pytest.raises(InputError, match="edited since it was saved"):
        load_kept(tmp_path / "kept.json")


def test_kept_results_have_the_same_bytes(kept: Kept, tmp_path: Path):
    """The bytes don't depend on the order of the runs, or on being read and written again."""
    turned = {label: dict(reversed(runs.items())) for label, runs in reversed(kept.runs.items())}
    assert dumps(replace(kept, runs=turned)) == dumps(kept)
    save(tmp_path / "kept.json", kept)
    assert dumps(load_kept(tmp_path / "kept.json")) == dumps(kept)
    assert max(map(len, dumps(kept).splitlines())) < 1000  # a line a list, so that changes can be read


def test_words_of_kept_results_stay_as_they_are(kept: Kept, tmp_path: Path):
    """Spaces and brackets in the names of clips, and in flags, are no layout."""
    word = "Subject 1  take [ 2 ]\u2028"
    runs = {
        label: {seed: replace(run, clips={f"{clip}{word}": rows for clip, rows in run.clips.items()})
                for seed, run in of_arm.items()}
        for label, of_arm in kept.runs.items()
    }  # fmt: skip
    save(tmp_path / "kept.json", replace(kept, runs=runs, flags=(word, "two  spaces")))
    read = load_kept(tmp_path / "kept.json")
    assert read.flags == (word, "two  spaces")
    assert [set(run.clips) for run in read.every] == [
        {f"{clip}{word}" for clip in run.clips} for run in kept.every
    ]


def test_two_evaluations_of_one_run_are_kept_apart(sweep: Sweep, kept: Kept, tmp_path: Path):
    """Arms may show inverse kinematics of two kinds of one training."""
    one, two = list(kept.runs)[:2]
    solved = {
        seed: replace(run, id=kept.runs[one][seed].id, sources={}) for seed, run in kept.runs[two].items()
    }
    save(tmp_path / "kept.json", replace(kept, runs=kept.runs | {two: solved}))
    read = load_kept(tmp_path / "kept.json")
    for label in (one, two):
        for seed, run in kept.runs[label].items():
            found = read.runs[label][seed]
            assert found.id == kept.runs[one][seed].id
            assert found.value("stream", "combined", "MPJPE") == pytest.approx(
                run.value("stream", "combined", "MPJPE"), rel=1e-5
            )
    assert read.count == len({run.id for runs in read.runs.values() for run in runs.values()})
    assert len(read.every) == read.count + len(solved)
    assert dumps(read) == (tmp_path / "kept.json").read_text()
    table = make_table(sweep, read.of(sweep))
    assert not any("are one run" in flag and two in flag for flag in table.flags)


def test_results_of_several_machines_add_up(sweep: Sweep, kept: Kept, tmp_path: Path):
    """Arms and seeds of both are there. A cell that both have is the newer one's; the other run is gone."""
    one = {label: {0: runs[0]} for label, runs in kept.runs.items()}
    newer = fake_run(tmp_path, "again", 0)
    other = runs_of(replace(sweep, seeds=(0,)), lambda arm, seed: newer if arm.label == "2" else None)
    rest = {label: {seed: runs[seed] for seed in (1, 2)} for label, runs in kept.runs.items()}
    merged = replace(kept, runs=one).merged(replace(kept, runs=rest)).merged(replace(kept, runs=other))
    assert {label: sorted(runs) for label, runs in merged.runs.items()} == {
        label: [0, 1, 2] for label in kept.runs
    }
    ids = set(json.loads(dumps(merged))["runs"])
    assert newer.id in ids
    assert kept.runs["2"][0].id not in ids
    with pytest.raises(InputError, match="holds the results of"):
        kept.merged(replace(kept, overrides=("data=synthetic",)))


def test_kept_results_hold_no_path_of_a_machine():
    words = ("data.root=/home/me/data/cmu", "data.root=outputs/data/cmu", "+data.body=/x/model.npz")
    assert without_paths(words) == (
        "data.root=.../cmu",
        "data.root=outputs/data/cmu",
        "+data.body=.../model.npz",
    )


@pytest.mark.parametrize("text", ["{", "[]", '{"sweep": "a"}', '{"runs": {"a": {}}}'])
def test_damaged_results_are_one_line(tmp_path: Path, text: str):
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(InputError, match="memmlp results save"):
        load_kept(path)


def test_a_template_takes_numbers_and_verdicts_from_the_table(sweep: Sweep, kept: Kept):
    made = source(sweep, kept)
    template = (
        'MPJPE {{ effect("t", "2", "stream", "MPJPE") }}; paper {{ paper("t", "2", "MPJPE") }}; '
        '{{ value("t", "2", "stream", "MPJPE") }}. {{ verdict("t", "2, 4, 6", "window", "Jitter") }} '
        '{{ seen("t", "stream", "MPJPE") }} {% if has("u") %}never{% endif %}\n'
        '{{ title("t") }}\n{{ origin("t") }}\n{{ summary("t") }}\n{{ table("t") }}\n'
    )
    text = pages({"t": made}, {"README.md": template})["README.md"]
    row = next(row for row in made.table.rows if row.label == "2")
    effect = row.cells["stream"]["MPJPE"].effect
    assert effect.verdict == Verdict.HOLDS
    assert f"MPJPE +{effect.mean:.2f} [{effect.low:.2f}, {effect.high:.2f}], holds; paper +0.09" in text
    assert f"{row.cells['stream']['MPJPE'].mean:.2f} ± " in text
    assert f"{made.table.detectable('stream', 'MPJPE'):.2g} cm" in text
    assert "`memmlp sweep table14 data=mocap`: 12 runs, commit 0123456, torch 2.0.0" in text
    assert text.count("holds; paper +0.09") == 2
    assert "never" not in text
    assert "### Table 14: Placement of memory blocks in the backbone" in text


def test_what_holds_of_the_paper_is_counted_and_listed(sweep: Sweep, kept: Kept):
    """Counted anew from the cells; an effect without a sign in the paper is not."""
    made = source(sweep, kept)
    text = pages({"t": made}, {"README.md": '{{ held(["t"]) }}\n'})["README.md"]
    cells = [row.cells["stream"][metric] for row in made.table.rows for metric in made.table.measured_metrics]
    signed = [cell for cell in cells if cell.paper_effect]
    holds = sum(cell.effect.verdict == Verdict.HOLDS for cell in signed)
    assert 0 < holds < len(signed) == 12
    assert f"Of {len(signed)} effects with a sign in the paper, in stream mode: holds {holds}, " in text
    line = next(line for line in text.splitlines() if line.startswith("| [14](t.md) | 2 |"))
    row = next(row for row in made.table.rows if row.label == "2")
    words = [str(row.cells["stream"][metric].effect.verdict) for metric in made.table.measured_metrics]
    assert line == f"| [14](t.md) | 2 | 2, 4, 6, 8 | {' | '.join(words)} |"


def test_each_commit_is_named_once(kept: Kept):
    runs = kept.runs["2"]
    for seed, code in zip(runs, ("e2f8fc0", "92ecce3, e2f8fc0", "e2f8fc0, 92ecce3"), strict=False):
        runs[seed] = replace(runs[seed], origin=replace(runs[seed].origin, code=code))
    assert ", commit 0123456, 92ecce3 and e2f8fc0, torch" in origin_words(kept)


@pytest.mark.parametrize(
    ("template", "words"),
    [
        ('{{ effect("u", "2", "stream", "MPJPE") }}', "'u' is no results; allowed are t"),
        ('{{ effect("t", "3", "stream", "MPJPE") }}', "'3' is no arm of t; allowed are 2, 2, 4"),
        ('{{ effect("t", "2", "live", "MPJPE") }}', "'live' is no mode; allowed are stream, window"),
        ('{{ effect("t", "2", "stream", "MPJ") }}', "'MPJ' is no metric of t"),
        ("{{ nothing }}", "'nothing' is undefined"),
        ("{{ effect(", "README.md"),
        ('Memory lowers it: {{ effect("t", "2", "stream", "MPJPE") }}', "placeholders"),
    ],
)
def test_bad_templates_are_one_line(sweep: Sweep, kept: Kept, template: str, words: str):
    with pytest.raises(InputError, match=re.escape(words)) as raised:
        pages({"t": source(sweep, kept)}, {"README.md": template})
    assert str(raised.value).startswith("README.md")
    assert "\n" not in str(raised.value)


def test_a_template_cannot_stand_for_a_tables_page(sweep: Sweep, kept: Kept):
    with pytest.raises(InputError, match=r"t\.md"):
        pages({"t": source(sweep, kept)}, {"t.md": "words"})


@pytest.mark.parametrize(
    "sentence",
    [
        "Jitter is +1.47* here.",
        r"Jitter is +1.47\* here.",
        "MPJPE changes by 0.3 [0.1, 0.5] cm.",
        "The memory lowers the position error by 0.17 cm.",
        "The memory raises Jitter.",
        "The memory loses against a GRU.",
        "The effect is significant.",
        "Placing it {{ effect('t', 'a', 'stream', 'MPJPE') }} further back is better.",
        "| arm | MPJPE | the effect 0.2 holds |",
        "- first\n- *manual* weights improve MPJRE",
    ],
)
def test_a_planted_claim_is_found(sentence: str):
    text = f"# Title\n\nThis is prose about 41 frames. {sentence}\n\nMore of it.\n"
    found = claims(text)
    assert len(found) == 1
    assert found[0].line == 3 + sentence.count("\n")


@pytest.mark.parametrize(
    "sentence",
    [
        "The arm has {{ effect('t', 'a', 'stream', 'MPJPE') }}.",
        "Table 4 is better than none.",
        "`3.0* better` is code, [and this](https://x.org/better*3) an address.",
        "<!-- 0.17 cm lower -->",
        "A folder of 3 runs. It is better to keep them.",
        "Frames [2, 4] are listed.",
        "**30** clips, *in* order.",
    ],
)
def test_what_claims_nothing_is_left_alone(sentence: str):
    assert claims(f"{sentence}\n") == []


def test_every_word_of_the_rule_is_found():
    for word in (*WORDS, *NEVER):
        assert len(claims(f"It {word} 0.3 cm.")) == 1


@functools.cache
def kept_tables() -> dict[str, KeptTable]:
    """The tables of the clone's kept results, computed once for the tests that read them."""
    return sources(DOCS)


@pytest.mark.slow
def test_pages_of_the_clone_are_made_again_byte_for_byte():
    templates = {path.name: path.read_text(encoding="utf-8") for path in (DOCS / "templates").glob("*.md")}
    made = pages(kept_tables(), templates)
    assert "README.md" in made
    for name, text in made.items():
        assert (DOCS / name).read_bytes() == text.encode(), name


@pytest.mark.slow
def test_every_interval_of_the_clone_follows_from_what_is_kept():
    """As many intervals as the pages print are computed here from the per-clip results, and are equal."""
    for name, one in kept_tables().items():
        text, printed = (DOCS / f"{name}.md").read_text(encoding="utf-8"), []
        content = json.loads((DOCS / "data" / f"{name}.json").read_text())
        sources_of = [None, *(one.kept.sources if one.by_source else ())]
        for source_name, table in zip(sources_of, (one.table, *one.by_source), strict=True):
            for row in table.rows:
                for mode, cells in row.cells.items():
                    for metric, cell in cells.items():
                        if cell.effect is not None and cell.effect.low is not None:
                            interval = by_hand(content, row, table, mode, metric, source_name)
                            assert (cell.effect.low, cell.effect.high) == pytest.approx(interval)
                            printed.append(interval)
        assert len(re.findall(r"\\\[[^\]]*\d, [^\]]*\d\\\]", text)) == len(printed)


def by_hand(
    content: dict, row, table, mode: str, metric: str, source: str | None = None
) -> tuple[float, float]:
    """Compute the interval of a row's difference from its control, from a file's content alone.

    source: whose clips count; None for all.
    """
    branches = {other.label: other.branch for other in table.rows}
    seeds = sorted(set(content["cells"][row.label]) & set(content["cells"][row.against]))
    every = {
        label: [content["runs"][content["cells"][label][seed]] for seed in seeds]
        for label in (row.label, row.against)
    }
    clips = [
        {clip: (group, *rest) for clip, group, *rest in content["clips"][runs[0]["clips"]]}
        for runs in every.values()
    ]
    groups = {
        clip: group
        for clip, (group, *rest) in clips[0].items()
        if clip in clips[1] and (source is None or rest == [source])
    }
    sides = []
    for (label, runs), names in zip(every.items(), clips, strict=True):
        places = [list(names).index(clip) for clip in groups]
        errors = [run["errors"][mode][branches[label]][metric] for run in runs]
        sides.append(np.array(errors)[:, places])
    effects = paired_effects((sides[0] - sides[1])[None], np.array(list(groups.values())))
    return float(effects.low[0]), float(effects.high[0])


def test_the_way_from_the_first_arm_to_the_last_is_the_sum_of_its_steps(sweep: Sweep, tmp_path: Path):
    """Errors grow from arm to arm of a chain; a share is shown where the interval leaves 0 out."""
    labels = [arm.label for arm in sweep.arms]
    against = {labels[0]: labels[1], labels[1]: labels[2], labels[2]: labels[0]}  # the control, two before it
    arms = tuple(replace(arm, against=against.get(arm.label)) for arm in sweep.arms)
    chained = replace(sweep, arms=arms, control=labels[0])
    find = fake_sweep(tmp_path, chained, {labels[1]: 1.1, labels[2]: 1.3}, groups=GROUPS)
    words = Words({"t": source(chained, Kept("table14", (), runs_of(chained, find), overrides_of(chained)))})
    rows = [line.split(" | ") for line in words.way("t").splitlines()[2:]]
    assert [row[0].strip("| ") for row in rows] == [
        labels[1], labels[0], f"**the whole way, from {labels[2]}**"
    ]  # fmt: skip
    column = 1 + chained.metrics.index("MPJPE")
    parts = [[word.replace(MINUS, "-") for word in row[column].split(", ")] for row in rows]
    assert float(parts[0][0]) + float(parts[1][0]) == pytest.approx(float(parts[2][0]), abs=0.011)
    assert [part[1] for part in parts[:2]] == ["67 %", "33 %"]  # 1.3 to 1.1 to 1
    assert parts[2][1].split("; paper ")[0] == str(words.verdict("t", labels[2], "stream", "MPJPE"))
    plain = Words({"t": source(sweep, Kept("table14", (), runs_of(sweep, find), overrides_of(sweep)))})
    assert plain.way("t") == ""


def test_results_of_an_arm_that_was_another_are_refused(sweep: Sweep, kept: Kept):
    """Otherwise its numbers would stand under a label that means something else now."""
    arms = [replace(arm, overrides=("memory=gru",)) if arm.label == "2" else arm for arm in sweep.arms]
    other = replace(sweep, arms=tuple(arms))
    with pytest.raises(InputError, match="arm '2' was made with the overrides"):
        kept.of(other)
    with pytest.raises(InputError, match="arm '2' was made with the overrides"):
        kept.merged(replace(kept, arms=overrides_of(other)))


def test_runs_that_an_arm_would_not_have_today_are_refused(kept: Kept):
    """Its words are the same where a default has changed, and its runs are not."""
    today = {(label, seed): run.id for label, runs in kept.runs.items() for seed, run in runs.items()}
    kept.check_runs(today)
    kept.check_runs({("2", 9): "of a seed that is not kept"})
    with pytest.raises(InputError, match=r"arm '2' has other runs than .* make \(seed 1, 2\)"):
        kept.check_runs(today | {("2", 2): "f" * 16, ("2", 1): "e" * 16})


def test_prose_claims_nothing_by_hand():
    for path in (ROOT / "README.md", *(DOCS / "templates").glob("*.md")):
        assert claims(path.read_text(encoding="utf-8")) == [], path


def test_by_hand_is_what_a_page_has(sweep: Sweep, kept: Kept):
    """What the test of the committed pages computes is checked on results made here, too."""
    content, table = json.loads(dumps(kept)), source(sweep, kept).table
    row = table.rows[0]
    effect = row.cells["stream"]["MPJPE"].effect
    assert by_hand(content, row, table, "stream", "MPJPE") == pytest.approx(
        (effect.low, effect.high), abs=1e-4
    )
    assert holm(np.array([effect.p]))[0] <= effect.holm


def test_nothing_to_keep(sweep: Sweep):
    assert Kept("table14", (), runs_of(sweep, nothing), {}).every == []


def test_an_arm_that_was_never_run_may_become_another(sweep: Sweep, kept: Kept):
    waiting = replace(kept, runs={**kept.runs, "2": {}})
    other = {**kept.arms, "2": ("memory=gru",)}
    waiting.check(other)
    assert waiting.merged(replace(kept, arms=other)).arms["2"] == ("memory=gru",)
