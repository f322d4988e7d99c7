"""What a sweep leaves in its folder is what its table says."""

from __future__ import annotations

import json
from pathlib import Path

from fake_runs import fake_run, fake_sweep, table_of

from memmlp.common.files import read_json
from memmlp.runs.loggers.facts import SweepFacts
from memmlp.sweep.plan import Entry, Plan, RunTask
from memmlp.sweep.sweep_file import load_sweep
from memmlp.tables.sweep_summary import write_summary


def written(folder: Path) -> Path:
    """A sweep's file: two variants, three seeds."""
    path = folder / "mine.yaml"
    path.write_text(
        "title: Mine\nseeds: [0, 1, 2]\ncontrol: full\nmetrics: [MPJPE]\n"
        "variants:\n  full: []\n  none: ['memory=none']\n"
    )
    return path


def test_table_means_verdicts_labels_and_status(tmp_path: Path):
    sweep = load_sweep(written(tmp_path))
    find = fake_sweep(tmp_path, sweep, {"none": 1.5})
    runs = {(variant.label, seed): find(variant, seed) for variant in sweep.variants for seed in sweep.seeds}
    entries = tuple(Entry(label, seed, run.id) for (label, seed), run in runs.items() if run)
    tasks = tuple(RunTask(entry.id, "memmlp", {}) for entry in entries)
    plan, folder = Plan("mine", tmp_path, entries, tasks), tmp_path / "sweeps" / "mine"
    table = table_of(sweep, find)
    write_summary(plan, table, folder)
    facts = SweepFacts.read(folder)
    assert facts is not None
    assert (facts.name, facts.status) == ("mine", "done")
    assert facts.variants == {entry.id: entry.label for entry in entries}
    cell = next(row for row in table.rows if row.label == "none").cells["stream"]["MPJPE"]
    assert cell.effect is not None
    assert facts.aggregates["none/stream/MPJPE"] == cell.mean
    assert facts.verdicts["none/stream/MPJPE"] == cell.effect.verdict
    assert [path.name for path in facts.files] == ["table.md", "table.html"]
    assert "Mine" in facts.files[0].read_text()


def test_a_run_of_two_variants_has_both_labels_and_means_that_are_no_numbers_are_left_out(tmp_path: Path):
    sweep = load_sweep(written(tmp_path))
    run, table = fake_run(tmp_path, "one"), table_of(sweep, fake_sweep(tmp_path, sweep))
    entries = tuple(Entry(label, 0, run.id) for label in ("full", "none"))
    write_summary(Plan("mine", tmp_path, entries, (RunTask(run.id, "memmlp", {}),)), table, tmp_path)
    content = read_json(tmp_path / "summary.json")
    assert content["labels"] == {run.id: "full, none"}
    content["aggregates"]["full/stream/MPJPE"] = "nan"
    (tmp_path / "summary.json").write_text(json.dumps(content))
    facts = SweepFacts.read(tmp_path)
    assert facts is not None
    assert "full/stream/MPJPE" not in facts.aggregates
    assert "none/stream/MPJPE" in facts.aggregates


def test_a_sweep_with_a_failed_run_failed_and_one_with_a_missing_run_stopped(tmp_path: Path):
    sweep = load_sweep(written(tmp_path))
    table, run = table_of(sweep, fake_sweep(tmp_path, sweep)), fake_run(tmp_path, "other")
    entry, task = Entry("full", 0, run.id), RunTask(run.id, "memmlp", {})
    plan = Plan("mine", tmp_path, (entry,), (task,))
    run.marker.unlink()
    write_summary(plan, table, tmp_path)
    assert read_json(tmp_path / "summary.json")["status"] == "stopped"
    with run.lock():
        write_summary(plan, table, tmp_path)
    assert read_json(tmp_path / "summary.json")["status"] == "running"
    run.fail("why")
    write_summary(plan, table, tmp_path)
    assert read_json(tmp_path / "summary.json")["status"] == "failed"
