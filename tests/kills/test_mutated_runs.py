"""Mutated run folders and archives: the good run is shown, and each bad one is one line."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from resource import RUSAGE_SELF, getrusage

import pytest
from conftest import Memmlp, one_line
from fake_logger import FakeLogger
from processes import until
from rich.console import Console

from benchmarks.mutated_runs import STAGES, make_archives, make_mutants, make_run
from memmlp.report.tables.build_table import (
    find_finished_runs,
    make_run_finder,
    make_state_finder,
    make_table,
)
from memmlp.report.tables.measured_run import load_measured_run
from memmlp.report.tables.table_text import to_json
from memmlp.report.ui.server import Answers
from memmlp.runs.loggers.logger import sync_runs
from memmlp.runs.lookup import list_runs
from memmlp.sweep.plan import Entry, Plan, RunTask
from memmlp.sweep.progress_table import render
from memmlp.sweep.sweep_file import parse_sweep

MAX_SECONDS, MAX_KILOBYTES = 5.0, 300_000
COUNTS = [40, pytest.param(500, marks=pytest.mark.long)]


@contextmanager
def timed(command: str) -> Iterator[None]:
    started, size = time.process_time(), getrusage(RUSAGE_SELF).ru_maxrss
    yield
    assert time.process_time() - started < MAX_SECONDS, command
    assert getrusage(RUSAGE_SELF).ru_maxrss - size < MAX_KILOBYTES, command


@pytest.mark.parametrize("count", COUNTS)
def test_damaged_runs_hide_no_other(memmlp: Memmlp, tmp_path: Path, count: int):
    good = make_run(tmp_path / "outputs", "the good run")
    runs = [good, *make_mutants(tmp_path / "outputs", count)]
    bad = {run.id for run in runs if run.damage}
    assert good.id not in bad
    assert len(bad) > count / 3
    with timed("runs list"):
        ran = memmlp("runs", "list", "--all")
    lines = ran.err.splitlines()
    assert (ran.code, good.id in ran.out, len(lines)) == (0, True, len(bad))
    assert all(sum(run_id in line for line in lines) == 1 for run_id in bad)

    with timed("ui"):
        answers = Answers(tmp_path / "outputs", lambda *words: {})
        until(lambda: len(answers.answer("runs", {})["rows"]) == len(runs), "the page has read all runs")
        rows = {row["id"]: row for row in answers.answer("runs", {})["rows"]}
    assert {run_id for run_id, row in rows.items() if row["damage"]} == bad
    for run in runs:
        page = answers.answer(f"run/{run.id}", {})
        assert bool(page["clips"]) or run is not good
        answers.answer("curves", {"runs": run.id})

    entries = [Entry("bad" if run is not good else "good", n, run.id, STAGES) for n, run in enumerate(runs)]
    tasks = [RunTask(run.id, "memmlp", {"optim": {"steps": 600}}, None, STAGES) for run in runs]
    plan = Plan("mine", tmp_path / "outputs", tuple(entries), tuple(tasks))
    console = Console(width=1000, file=io.StringIO(), record=True)
    with timed("sweep --status"):
        console.print(render(plan, plan.read_states()))
    lines = console.export_text().splitlines()
    assert all(sum(f"/{run_id}/" in line for line in lines) == 1 for run_id in bad)

    variants = {"good": {"overrides": []}, "bad": {"overrides": ["a=b"]}}
    sweep = parse_sweep(
        "mine", {"title": "T", "seeds": list(range(count + 1)), "variants": variants, "metrics": ["MPJPE"]}
    )
    with timed("table"):
        found = find_finished_runs(sweep, make_run_finder(plan, load_measured_run))
        table = make_table(sweep, found, describe_run=make_state_finder(plan))
    assert list(found["good"]) == [0]
    assert not bad & {run.id for run in found["bad"].values()}
    text = to_json(table)
    assert all(text.count(f"/{run_id}/") == 1 for run_id in bad)

    logger, warnings = FakeLogger(), []
    with timed("loggers sync"):
        sync_runs(logger, list_runs(tmp_path / "outputs"), warnings.append)
    assert good.id in logger.server.fingerprints
    assert all(sum(run_id in line for line in warnings) == 1 for run_id in bad)


@pytest.mark.parametrize("count", COUNTS)
def test_damaged_archives_are_refused_or_are_sound_runs(memmlp: Memmlp, tmp_path: Path, count: int):
    outputs, accepted = tmp_path / "outputs", []
    good = make_run(outputs, "the good run")
    for path in make_archives(tmp_path / "from anybody", count):
        with timed(f"runs import {path.name}"):
            ran = memmlp("runs", "import", str(path))
        if ran.code:
            assert one_line(ran, str(path))
        else:
            accepted.append(path)
    runs = list_runs(outputs)
    assert len(runs) == len(accepted) + 1
    assert len(accepted) < count * 2 / 3
    assert good.id in memmlp("runs", "list", "--all").out
    assert not any(run.damage or run.verify() for run in runs if run.id != good.id)
    assert {path.name for path in outputs.glob("*/*")} == {run.id for run in runs}
