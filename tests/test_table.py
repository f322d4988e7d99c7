"""Tables of measured runs beside the paper's values."""

from __future__ import annotations

import functools
import io
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_runs import CLIPS, ORIGIN, fake_run, fake_sweep
from rich.console import Console

from memmlp.errors import InputError
from memmlp.runs import Run
from memmlp.sweep.spec import Sweep, load_sweep, parse_sweep
from memmlp.tables.collect import Effect, Table, collect, without_runs
from memmlp.tables.grid import heading
from memmlp.tables.measured import load
from memmlp.tables.render import FORMATS, show

SHIPPED = Path(__file__).parent.parent / "sweeps"
FILE = {
    "title": "Memory & its <parts>",
    "table": 11,
    "notes": ["a note of the file"],
    "seeds": [0, 1, 2],
    "reference": "full_model",
    "metrics": ["MPJRE", "MPJPE", "Jitter", "FLOPs", "ms"],
    "arms": {
        "a system": {"overrides": None, "paper": {"MPJPE": 4.0}},
        "no | memory": {"overrides": ["memory=none"], "paper": {"MPJRE": 2.76, "MPJPE": 3.0, "Jitter": 7.0}},
        "by position": {"branch": "position", "overrides": ["a=b"], "note": "as <printed>"},
        "full_model": {"overrides": [], "paper": {"MPJRE": 2.57, "MPJPE": 3.08, "Jitter": 7.0}},
    },
}  # fmt: skip
EFFECTS = {"no | memory": 1.2}


@pytest.fixture
def sweep() -> Sweep:
    return parse_sweep("table11", FILE)


@pytest.fixture
def table(sweep: Sweep, tmp_path: Path) -> Table:
    return collect(sweep, fake_sweep(tmp_path, sweep, EFFECTS))


def cell(table: Table, label: str, metric: str, mode: str = "stream"):
    return next(row for row in table.rows if row.label == label).cells[mode][metric]


def printed(table: Table, width: int) -> str:
    console = Console(width=width, markup=False, highlight=False, file=io.StringIO())
    show(table, console)
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_mean_and_sd_over_seeds(sweep: Sweep, table: Table, tmp_path: Path):
    values = [Run.of(tmp_path, run.name).results for run in (tmp_path / "runs").iterdir()]
    mine = [
        results["window"]["rotation"]["MPJPE"]
        for run, results in zip((tmp_path / "runs").iterdir(), values, strict=True)
        if Run(run).config["overrides"] == ["memory=none"]
    ]
    found = cell(table, "no | memory", "MPJPE", "window")
    assert sorted(found.values.values()) == sorted(mine)
    assert found.mean == pytest.approx(np.mean(mine))
    assert found.sd == pytest.approx(np.std(mine, ddof=1))


def test_difference_is_paired_by_seed_and_clip(sweep: Sweep, tmp_path: Path):
    """Effects that both arms share cancel: the interval is far narrower than the arms' own spread."""
    table = collect(sweep, fake_sweep(tmp_path, sweep, EFFECTS))
    effect = cell(table, "no | memory", "MPJPE").effect
    assert effect is not None
    assert (effect.seeds, effect.clips) == (3, 4)
    assert effect.low < effect.mean < effect.high
    means = [cell(table, label, "MPJPE").mean for label in ("no | memory", "full_model")]
    assert effect.mean == pytest.approx(means[0] - means[1])
    assert effect.mean == pytest.approx(0.2 * means[1], rel=0.1)
    assert effect.significant
    assert effect.high - effect.low < 1.0
    between_clips = load(next((tmp_path / "runs").iterdir())).by_clip(
        list(CLIPS), "stream", "rotation", "MPJPE"
    )
    assert np.ptp(between_clips) > 1.5


def test_correction_is_over_all_modes_and_metrics(table: Table):
    effects = [
        c.effect for row in table.rows for cells in row.cells.values() for c in cells.values() if c.effect
    ]
    tested = [effect for effect in effects if effect.p is not None]
    assert table.comparisons == len(tested) == 2 * 3 + 2 * 2  # by position has no MPJRE
    smallest = min(tested, key=lambda effect: effect.p)
    assert smallest.holm == pytest.approx(min(1, smallest.p * len(tested)))


def test_signs_against_the_paper(table: Table):
    assert cell(table, "no | memory", "MPJRE").agrees is True  # +0.19 in the paper, worse here too
    assert cell(table, "no | memory", "MPJPE").agrees is False  # -0.08 in the paper
    assert cell(table, "no | memory", "Jitter").agrees is None  # no difference in the paper
    assert cell(table, "by position", "MPJPE").agrees is None  # not in the paper
    assert table.signs == (2, 4, 2, 4)


def test_costs_come_from_the_latency(table: Table):
    assert cell(table, "full_model", "FLOPs").mean == pytest.approx(0.026)
    assert cell(table, "no | memory", "ms").mean == pytest.approx(0.96)
    assert cell(table, "no | memory", "ms").effect == Effect(pytest.approx(0.16))


def test_costs_have_the_tables_units(tmp_path: Path):
    costs = load(fake_run(tmp_path, "run").folder).costs
    sizes = {"FLOPs": 0.026, "MACs": 0.013, "parameters": 0.356798, "size": 1.9}
    assert costs == pytest.approx({**sizes, "ms": 0.8, "ratio": 0.6, "FPS": 1250})


def test_a_branch_without_rotations_has_no_mpjre(table: Table):
    assert cell(table, "by position", "MPJRE").mean is None
    assert cell(table, "by position", "MPJPE").mean is not None


def test_missing_runs_are_shown_with_the_command(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep)
    unfinished = find(sweep.arms[1], 1)
    assert unfinished is not None
    unfinished.marker.unlink()
    unfinished.fail("loss is NaN")
    gone = {("by position", seed) for seed in (0, 1, 2)}
    table = collect(
        sweep,
        lambda arm, seed: None if (arm.label, seed) in gone else find(arm, seed),
        command="memmlp sweep 11 data=mocap",
    )
    rows = {row.label: row for row in table.rows}
    assert (rows["no | memory"].found, rows["by position"].found) == ((0, 2), ())
    gaps = "'no | memory' seed 1 (failed), 'by position' seed 0, 1, 2"
    assert f"missing: {gaps}; fill with: memmlp sweep 11 data=mocap" in table.flags
    effect = cell(table, "no | memory", "MPJPE").effect
    assert effect is not None
    assert effect.seeds == 2
    assert cell(table, "by position", "MPJPE").effect is None
    assert "2/3" in printed(table, 100)
    assert "0/3" in FORMATS["md"](table)


def test_no_reference_no_differences(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep)
    table = collect(sweep, lambda arm, seed: None if arm.label == "full_model" else find(arm, seed))
    assert table.comparisons == 0
    assert all(c.effect is None for row in table.rows for cells in row.cells.values() for c in cells.values())


def test_unequal_clips_are_flagged_and_left_out(sweep: Sweep, tmp_path: Path):
    runs = {
        (arm.label, seed): fake_run(
            tmp_path, arm.label, seed, clips=CLIPS[:3] if arm.label == "full_model" else CLIPS[1:]
        )
        for arm in sweep.runnable()
        for seed in (0, 1)
    }
    table = collect(replace(sweep, seeds=(0, 1)), lambda arm, seed: runs[arm.label, seed])
    effect = cell(table, "no | memory", "MPJPE").effect
    assert effect is not None
    assert effect.clips == 2
    assert abs(effect.mean) < 0.3  # the clip that is far harder than the others is not compared with them
    assert sum("unequal test clips" in flag and "share 2 of 4" in flag for flag in table.flags) == 2


def test_a_clip_that_is_no_number_is_left_out(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep)
    run = find(sweep.arms[3], 1)
    assert run is not None
    rows = json.loads(run.clips.read_text())
    rows[0]["stream"]["rotation"]["Jitter"] = "nan"
    run.clips.write_text(json.dumps(rows))
    table = collect(sweep, find)
    assert [cell(table, "no | memory", metric).effect.clips for metric in ("Jitter", "MPJPE")] == [3, 4]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"git": {"commit": "fedcba9876543210", "dirty": False}}, ("code differs", "fedcba9", "0123456")),
        ({"git": ORIGIN["git"] | {"dirty": True}}, ("uncommitted changes", "'by position'")),
        ({"data": "e" * 64}, ("data differs", "dddddddd of 'no | memory', 'full_model'", "eeeeeeee of 'by")),
        ({"cpu": "Another one"}, ("hardware differs", "Another one of 'by position'")),
        ({"git": None}, ("code differs", "version 0.3.0 of 'by position'")),
    ],
)  # fmt: skip
def test_runs_of_different_origin_are_flagged(
    sweep: Sweep, tmp_path: Path, change: dict, words: tuple[str, ...]
):
    runs = {
        arm.label: fake_run(tmp_path, arm.label, origin=change if arm.label == "by position" else None)
        for arm in sweep.runnable()
    }
    table = collect(replace(sweep, seeds=(0,)), lambda arm, seed: runs[arm.label])
    flags = [flag for flag in table.flags if words[0] in flag]
    assert len(flags) == 1
    assert all(word in flags[0] for word in words)
    assert any("one seed" in flag for flag in table.flags)


def test_equal_origins_are_not_flagged(table: Table):
    assert table.flags == ()


def test_damaged_results_are_one_line(tmp_path: Path, sweep: Sweep):
    find = fake_sweep(tmp_path, sweep)
    run = find(sweep.arms[3], 1)
    assert run is not None
    for text in ("[{", "[5]"):
        run.clips.write_text(text)
        with pytest.raises(InputError, match=re.escape(str(run.clips))):
            collect(sweep, find)


def test_costs_that_are_no_numbers_are_left_out(tmp_path: Path):
    run = fake_run(tmp_path, "a")
    results = json.loads(run.results_path.read_text())
    results["latency"]["flops"] = "nan"
    run.results_path.write_text(json.dumps(results))
    costs = load(run.folder).costs
    assert "FLOPs" not in costs
    assert "parameters" in costs


def test_only_costs_need_one_block(tmp_path: Path):
    sweep = load_sweep(SHIPPED / "table16.yaml")
    table = collect(sweep, fake_sweep(tmp_path, sweep))
    assert len(table.modes) == 1
    assert not {"stream mode", "window mode"} & set(printed(table, 100).splitlines())
    assert table.flags == ()


def test_costs_show_how_many_times_the_references_they_are(tmp_path: Path):
    """Of the fake arms' 0.8, 0.88, 0.96 ms, and of the paper's 6.0 and 30.1."""
    sweep = load_sweep(SHIPPED / "table17.yaml")
    text = printed(collect(sweep, fake_sweep(tmp_path, sweep)), 100)
    table = collect(sweep, fake_sweep(tmp_path, sweep))
    ms = [row.cells[table.modes[0]]["ms"].mean for row in table.rows]
    assert f"(x {ms[1] / ms[0]:.3g})" in text
    assert f"(x {30.1 / 6.0:.3g})" in text


def test_heads_tell_unit_and_direction():
    assert [heading(name) for name in ("Jitter", "ms", "FPS")] == ["Jitter [10² m/s³] ↓", "ms ↓", "FPS ↑"]


def test_long_labels_fold_so_that_four_metrics_fit(tmp_path: Path):
    sweep = load_sweep(SHIPPED / "table04.yaml")
    assert printed(collect(sweep, fake_sweep(tmp_path, sweep)), 100).count("Jitter ↓") == 2


@pytest.mark.parametrize("width", [80, 100])
@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_tables_fit_the_screen(tmp_path: Path, path: Path, width: int):
    sweep = load_sweep(path)
    text = printed(collect(sweep, fake_sweep(tmp_path, sweep)), width)
    assert max(map(len, text.splitlines())) <= width
    for arm in sweep.arms:
        assert arm.label.split()[0] in text
        for value in (arm.paper or {}).values():
            assert f"{value:.1f}" in text or f"{value:.2f}" in text
    assert text.count(f"{len(sweep.seeds)}/{len(sweep.seeds)}") >= len(sweep.runnable())


def test_screen_shows_everything_of_an_arm(table: Table):
    lines = [line.split("  ") for line in printed(table, 100).splitlines()]
    words = [[word.strip() for word in line if word.strip()] for line in lines]
    start = next(i for i, line in enumerate(words) if line[:1] == ["no | memory"])
    assert words[start][1] == "3/3"
    assert re.fullmatch(r"\d\.\d\d ± \d\.\d\d", words[start][2])
    assert re.fullmatch(r"\+\d\.\d+\*", words[start + 1][1])
    assert re.fullmatch(r"\[\d\.\d+, \d\.\d+\]", words[start + 2][0])
    assert words[start + 3][:3] == ["paper", "2.76 (+0.19 ✓)", "3.00 (−0.08 ✗)"]  # noqa: RUF001
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


def test_html_escapes(table: Table):
    text = FORMATS["html"](table)
    assert "Memory &amp; its &lt;parts&gt;" in text
    assert "<parts>" not in text
    assert text.count("<tbody>") == 2 * 4
    assert '<span class="opposite">✗</span>' in text


def test_json_has_the_values_of_each_seed(table: Table):
    content = json.loads(FORMATS["json"](table))
    found = content["rows"][1]["cells"]["stream"]["MPJPE"]
    expected = cell(table, "no | memory", "MPJPE")
    assert found["values"] == {str(seed): value for seed, value in expected.values.items()}
    assert found["effect"]["holm"] == expected.effect.holm
    assert (found["agrees"], found["paper"]) == (False, 3.0)
    assert content["rows"][0]["wanted"] == []


def test_collect_reads_each_run_once(sweep: Sweep, tmp_path: Path):
    """The work is linear in the runs: one reading a run, though each is in many comparisons."""
    many = parse_sweep("many", {"axes": {"optim.lr": list(range(1, 41))}, "seeds": [0, 1]})
    find, opened = fake_sweep(tmp_path, many), []

    def counted(folder: Path):
        opened.append(folder)
        return load(folder)

    collect(many, find, read=functools.cache(counted))
    assert len(opened) == len(set(opened)) == 80


def test_tables_need_no_torch():
    """Nor scipy.stats or matplotlib: together seconds to import, more than two thousand runs take."""
    code = "import sys, memmlp.cli.table, memmlp.tables.render as r; print(*sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"torch", "scipy.stats", "matplotlib", "hydra"} & set(ran.stdout.split())


def test_without_runs_the_papers_values_and_the_reason_are_shown():
    table = without_runs(
        load_sweep(SHIPPED / "table01.yaml"), ("stream", "window"), "nothing measured: data.root"
    )
    text = printed(table, 100)
    assert "nothing measured: data.root" in text
    assert "14.27" in text
    assert "missing" not in text
